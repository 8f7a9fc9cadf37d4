"""The report page: one HTML file that shows what a run did, without a server and without anything from elsewhere."""
