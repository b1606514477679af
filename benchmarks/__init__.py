"""Speed, memory and accuracy of camtorch beside OpenCV, kornia and the floor of the machine: `python -m benchmarks`.

One file is one subject: its `TABLES` name the contestants, and its `rows(options)` measures them.

* All contestants of a row take turns within one process, after a warm-up, and medians are taken: eager timings move by
  up to two between processes, ratios within one process do not.
* What a contestant wants in another shape or type is converted before the clock starts.
* "project" and "unproject" run under `torch.no_grad()`; "and backward" has gradients to the input and every parameter.
* Points, images and stereo have an error beside each speed, against the same camera in float64.
* `--cpu avx2` limits everyone to AVX2: camtorch, torch and OpenCV; kornia-rs cannot be limited.
"""

import os

# kineto prints two lines to stderr whenever memory is looked at; it reads this when torch is imported
os.environ.setdefault("KINETO_LOG_LEVEL", "99")
os.environ.setdefault("RAYON_NUM_THREADS", "1")  # of kornia-rs, which takes part in rows of one thread
