"""From the posed mesh to the canonical one: triangle maps, the deformer, the clearance grid."""
