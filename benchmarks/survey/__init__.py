"""Accuracy of the products of `chronoscene survey` on scenes whose truth is known."""
