"""Residuals, one file per kind, each written once and vectorised over its rows.

`block` says what a block of residuals is; `ranges` holds the one nonlinear residual, the others
(motion, odometry, depth and fixes, slow states, priors) are linear in the unknowns and build
`LinearBlock`s. GTSAM's factors are views on the rows of these blocks (`ubl_graph.gtsam_view`).
"""
