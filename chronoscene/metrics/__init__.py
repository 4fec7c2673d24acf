"""Image metrics. `table` names them all; `image` and `lpips` hold the formulas."""
