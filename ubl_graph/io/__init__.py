"""Reading missions from files and writing results: one module per format.

Nothing is imported here, so that a format's weight (pydantic for mission files) is paid only by
those who use it.
"""
