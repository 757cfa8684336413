"""How experience is gathered: a pool of CPU processes, or environments on the accelerator."""
