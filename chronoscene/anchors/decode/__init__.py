"""From the features of anchors to Gaussians: small MLPs, in torch and compiled."""
