"""Work for jobs, in a module that processes can import: outputs are their inputs, doubled."""

import os
import signal
import time
import warnings
from dataclasses import dataclass

from camtorch.io.writing import replacing


@dataclass
class Doubling:
    """What its inputs say, it does: "die", "fail", "wait", "note"."""

    def __call__(self, item):
        text = b"".join(path.read_bytes() for path in item.inputs)
        if text == b"die":
            os.kill(os.getpid(), signal.SIGKILL)
        if text == b"fail":
            raise ValueError(f"{item.inputs[0]}: it says so")
        if text == b"note":
            warnings.warn(f"{item.inputs[0]} is a note", stacklevel=1)
        for path in item.outputs:
            path.parent.mkdir(parents=True, exist_ok=True)
            with replacing(path, synced=False) as (file,):
                file.write(text)
                if text == b"wait":
                    (path.parent / "waiting").touch()
                    time.sleep(60)
                file.write(text + item.variant.encode())
        return {"size": 2 * len(text)}
