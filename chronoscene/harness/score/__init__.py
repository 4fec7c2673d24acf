"""Scoring: images and frozen ground truth go in, rows of metrics come out."""
