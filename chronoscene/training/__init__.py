"""Code shared by all methods that train tensors and splat them, whatever the tensors are.

`method` has the base class of the plug-ins and `config` their common options. `drawing` renders,
`losses` compares, `gradients` is the backward pass, `schedules` gives learning rates, and
`optimizers` step.
"""
