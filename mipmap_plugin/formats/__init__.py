"""Files as bytes and text: what a checkpoint or an image is made of, and outputs that appear whole or not at all."""
