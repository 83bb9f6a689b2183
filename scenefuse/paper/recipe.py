"""The paper's constants (He et al. 2026, section 4.2.2 and Table 1), and values for what it names without a number.

docs/paper.md lists which is which. How long stages are is a setting; in config/paper.yaml they sum to its 60 epochs.
"""

from scenefuse.nerf.field import FieldSettings
from scenefuse.nerf.losses import LossWeights
from scenefuse.nerf.training import NerfRecipe

BATCH_PHOTOS = 24
WARMUP_EPOCHS = 2
LEARNING_RATE = 1e-3
# Stages 2 and 4. The paper has neither samples near the prior, nor turned rays, nor gains of photos, nor levels that
# open one by one.
NERF = NerfRecipe(
    images_per_batch=BATCH_PHOTOS,
    rays_per_image=170,
    warmup_epochs=WARMUP_EPOCHS,
    learning_rate=LEARNING_RATE,
    grid_learning_rate=LEARNING_RATE,
    coarse_until=0.0,
    prior_share=0.0,
    turned_share=0.0,
    appearance=False,
)
# It gives no weights: they are the shipped ones. The distortion is not among its losses.
LOSSES = LossWeights(distortion_weight=0.0)
# Where there is a GPU: instant-ngp's field, which the paper's encoding is. On a CPU, the field of `object.nerf`.
FIELD = FieldSettings(levels=16, log2_table=19, finest=2048, width=64)
