"""The interactive app, and how it is started."""
