"""The workers as Ray actors."""
