"""Chapter 4 of the thesis on a synthetic tactile pad: models, the pulse experiment, docs/learned_inverse.md."""
