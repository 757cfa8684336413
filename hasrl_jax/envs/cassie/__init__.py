"""The walking task of the bipedal robot Cassie."""
