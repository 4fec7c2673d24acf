"""From photos of several dates to everything that is made of them: ``chronoscene all``.

`steps.STEPS` lists what is done, each step in a folder of its own; `run` does what is missing;
`record` keeps what each result was made of; `summary_page` links everything.
"""
