"""Time, memory and outcomes of trainings."""
