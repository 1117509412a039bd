"""Networks and their optimiser, which import torch only."""
