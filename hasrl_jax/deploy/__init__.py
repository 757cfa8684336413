"""Policies for use without this package: files in three formats, each with everything that is needed to play it."""
