"""A small task with a known answer."""
