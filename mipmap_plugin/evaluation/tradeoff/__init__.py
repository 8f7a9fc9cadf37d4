"""What accuracy costs in time, measured, drawn and written."""
