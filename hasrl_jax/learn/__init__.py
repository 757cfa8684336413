"""The learner: networks, returns, batching and the PPO step."""
