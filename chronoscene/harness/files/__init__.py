"""Files of a run: records, predictions, frozen ground truth, and what made them."""
