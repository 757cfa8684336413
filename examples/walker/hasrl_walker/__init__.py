"""A planar robot with two legs, from the MJCF that lies inside gymnasium."""
