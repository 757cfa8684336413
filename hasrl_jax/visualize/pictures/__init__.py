"""Pictures of how a policy walks."""
