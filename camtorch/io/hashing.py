"""What is in a file, in 32 characters."""

from __future__ import annotations

import hashlib
import os


def hash_of(path: str | os.PathLike[str]) -> str:
    """BLAKE2b of what is in a file, 16 bytes, hexadecimal.

    Raises:
        OSError: it cannot be read.
    """
    found = hashlib.blake2b(digest_size=16)
    with open(path, "rb") as file:
        while block := file.read(1 << 20):
            found.update(block)
    return found.hexdigest()
