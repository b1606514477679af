"""Speed, memory and accuracy of camtorch beside OpenCV, kornia and the floor of the machine: `python -m benchmarks`.

What makes the figures comparable, here once for all subjects:

* All contestants of one operation are timed in turns within one process, after a warm-up, and medians are taken: eager
  timings move by up to two between processes, ratios within one process do not.
* What a contestant wants in another shape or type is converted before the clock starts, unless the conversion is what
  the column is about ("tensor in, tensor out").
* "project" and "unproject" run under `torch.no_grad()`; "f+b" is forward and backward, with gradients to the input and
  to every parameter.
* Every speed has an error beside it, against the same camera in float64.
"""

import os

# kineto prints two lines to stderr whenever memory is looked at; it reads this when torch is imported
os.environ.setdefault("KINETO_LOG_LEVEL", "99")
