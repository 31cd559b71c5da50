"""The online estimator: a fixed lag inside mission software.

`estimator` is the front door. Behind it, `buffer` keeps the records of the last lag, `rows` turns
them into residual rows interval by interval, `window` holds nodes, rows and the prior that older
nodes have left, `equations` and the engines `lm` and `isam2` solve it, `gate` judges records before
they count, `search` finds a position where none is known, `health` says how far to trust it all.
"""
