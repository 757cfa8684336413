"""Configuration: its fields, their limits, YAML files and stages."""
