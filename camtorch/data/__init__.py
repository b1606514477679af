"""Images with their labels, sample by sample, for engines that spread them over workers: Ray Data, WebDataset, torch's.

What a sample becomes follows from the sample, its key, a seed and the epoch, whoever computes it beside whatever else.
"""

from camtorch.data.columns import from_columns, to_columns
from camtorch.data.labels import Samples, read
from camtorch.data.moving import MapBatches, MapSamples
from camtorch.data.seeded import Key, Seeded, generator

__all__ = ["Key", "MapBatches", "MapSamples", "Samples", "Seeded", "from_columns", "generator", "read", "to_columns"]
