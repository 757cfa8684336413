"""Films, pictures, curves and the viewer."""
