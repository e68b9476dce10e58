"""Processes that are controlled: plants and actuators."""
