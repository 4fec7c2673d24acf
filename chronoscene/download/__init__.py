"""Names of datasets and weights in; checked files from their hosts out.

`catalogue` is the table of datasets, `datasets` brings scenes to this machine and `weights` what
LPIPS needs. Everything comes through `transfer`.
"""
