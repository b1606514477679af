"""Images with their labels, one sample at a time, for loaders with workers: Ray Data, WebDataset and torch.

The result for a sample depends only on the sample, its key, a seed and the epoch, not on worker or batch.
"""

from camtorch.data.columns import from_columns, to_columns
from camtorch.data.detectors import from_dlib, from_insightface, from_mediapipe, from_ultralytics
from camtorch.data.labels import Samples, read
from camtorch.data.rows import MapBatches, MapSamples
from camtorch.data.seeded import Key, Seeded, generator

__all__ = [
    "Key",
    "MapBatches",
    "MapSamples",
    "Samples",
    "Seeded",
    "from_columns",
    "from_dlib",
    "from_insightface",
    "from_mediapipe",
    "from_ultralytics",
    "generator",
    "read",
    "to_columns",
]
