"""What methods share that train tensors and splat them, whatever the tensors are.

`splatting` has the base class of the plug-ins; it and the trainers stand on the rest: views and
learning rates, exposures, losses, Adam (also of some rows only), and checkpoints.
"""
