"""Ladders of levels: files of one scene for all zooms, of which a viewer shows the one that fits (`ladder.make_levels`)."""
