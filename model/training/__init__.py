"""Training the networks: objectives, schedules, the loop."""
