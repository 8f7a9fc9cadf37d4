"""The live view: what is drawn (`stage`), adapting for it (`adapting`), and the page in the browser (`page`)."""
