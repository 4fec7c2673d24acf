"""What methods share on the torch side: losses, optimiser, schedules, checkpoints, anchors."""
