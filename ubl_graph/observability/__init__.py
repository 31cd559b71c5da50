"""How well a geometry determines a track: dilutions of precision, rank, mirror images.

- `dops`, `window_dops`, `graph_dops`: by how much are range errors diluted?
- `rank`: which unknowns does a design matrix tell, and which directions does it leave open?
- `observability`: what does a whole mission leave open, and is there a second track that fits?
"""

from ubl_graph.observability.dilution import (
    Dops,
    dops,
    graph_dops,
    window_design,
    window_dops,
)
from ubl_graph.observability.directions import Rank, rank
from ubl_graph.observability.report import Mirror, Observability, mirror_image, observability

__all__ = [
    "Dops",
    "Mirror",
    "Observability",
    "Rank",
    "dops",
    "graph_dops",
    "mirror_image",
    "observability",
    "rank",
    "window_design",
    "window_dops",
]
