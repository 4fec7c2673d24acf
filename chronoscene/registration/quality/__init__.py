"""Quality of a registration: a `Registered` comes in, a certificate and a verdict go out.

`rays` gathers the observations once; the other modules measure; `certificate` collects their
figures, `verdict` judges them.
"""
