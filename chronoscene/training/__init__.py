"""What methods share that train tensors and splat them, whatever the tensors are.

`method` is the base class of the plug-ins; it and the trainers stand on the rest: start from sparse
points, views and learning rates, drawing, losses, Adam (also of rows), and checkpoints.
"""
