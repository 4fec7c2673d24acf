"""Image metrics: two images go in, a number comes out.

`registry` names them all and says which this machine can compute; the formulas are in `psnr_ssim`
and `lpips`.
"""
