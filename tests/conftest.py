"""Without a GPU, Triton's interpreter runs the GPU kernels; it has to know before they are imported."""

import os

import torch

if not torch.cuda.is_available():
    os.environ["TRITON_INTERPRET"] = "1"
