"""Reports: finished runs go in; tables, intervals, trade-offs, figures and pages come out."""
