"""What is fuzzed: a reader of files, a valid set of files for it, and how each file is damaged."""

from __future__ import annotations

import io
import json
import random
import struct
import zipfile
import zlib
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import safetensors.torch
from mutations import Mutator
from torch import Tensor

from kgs.fit.checkpoint import _digest_all

__all__ = ["Reader", "Target", "Unsound", "check_range", "inside_checkpoint", "inside_png", "inside_zip"]


class Unsound(Exception):
    """A reader let numbers pass that are not finite or not valid."""


@dataclass(frozen=True)
class Target:
    """A file that is damaged.

    Args:
        path: relative to the set's folder.
        mutate: the damage, see `mutations.py`.
    """

    path: str
    mutate: Mutator


@dataclass(frozen=True)
class Reader:
    """One reader of kgs.

    Args:
        name: what the tables call it.
        write: writes a valid set of files into a folder.
        read: reads them and checks what it got; raises DataError for files that are refused and `Unsound` for numbers
            that should not have passed.
        targets: the files that are damaged, one at a time.
        share: of the trials that others get, for a slow one.
    """

    name: str
    write: Callable[[Path], None]
    read: Callable[[Path], None]
    targets: tuple[Target, ...]
    share: float = 1.0

    def damage(self, folder: Path, seed: int) -> tuple[Path, bytes, str]:
        """The file of a valid set in `folder` that this seed damages, its damaged bytes, and what was done."""
        rng = random.Random(f"{self.name} {seed}")
        target = rng.choice(self.targets)
        path = folder / target.path
        data, what = target.mutate(path.read_bytes(), rng)
        return path, data, f"{self.name}, seed {seed}: {target.path}: {what}"


def check_range(name: str, value: Tensor, low: float = -1e30, high: float = 1e30) -> None:
    """Raise Unsound where a number is outside [low, high] or NaN."""
    if not bool(((value >= low) & (value <= high)).all()):
        raise Unsound(f"{name}: expected numbers from {low:g} to {high:g}")


def inside_checkpoint(mutate: Mutator, part: int) -> Mutator:
    """Damage to a checkpoint's JSON (part 1) or to its tensors (part 2), with the checksum made right again."""

    def mutate_part(data: bytes, rng: random.Random) -> tuple[bytes, str]:
        size = int.from_bytes(data[:8], "little")
        header, body = json.loads(data[8 : 8 + size]), data[8 + size :]
        metadata = header["__metadata__"]
        if part == 1:
            text, what = mutate(metadata["state"].encode(), rng)
            metadata["state"] = text.decode(errors="replace")
        else:
            body, what = mutate(body, rng)
            body = body[: len(data) - 8 - size].ljust(len(data) - 8 - size, b"\0")  # of the size in the header
        head = json.dumps(header).encode()
        tensors = safetensors.torch.load(len(head).to_bytes(8, "little") + head + body)
        metadata["sha256"] = _digest_all(metadata["state"], tensors)
        head = json.dumps(header).encode()
        return len(head).to_bytes(8, "little") + head + body, f"part {part}, checksum right: {what}"

    return mutate_part


def inside_zip(mutate: Mutator) -> Mutator:
    """Damage to one file of an archive, which is then packed again with its checksums right."""

    def mutate_member(data: bytes, rng: random.Random) -> tuple[bytes, str]:
        with zipfile.ZipFile(io.BytesIO(data)) as archive:
            members = {name: archive.read(name) for name in archive.namelist()}
        chosen = rng.choice(list(members))
        members[chosen], what = mutate(members[chosen], rng)
        packed = io.BytesIO()
        with zipfile.ZipFile(packed, "w", zipfile.ZIP_DEFLATED) as archive:
            for name, content in members.items():
                archive.writestr(zipfile.ZipInfo(name), content)
        return packed.getvalue(), f"{chosen}, checksum right: {what}"

    return mutate_member


def inside_png(mutate: Mutator) -> Mutator:
    """Damage to one chunk of a PNG image, its checksum made right again."""

    def mutate_chunk(data: bytes, rng: random.Random) -> tuple[bytes, str]:
        chunks, at = [], 8
        while at < len(data):
            size = struct.unpack_from(">I", data, at)[0]
            chunks.append((data[at + 4 : at + 8], data[at + 8 : at + 8 + size]))
            at += size + 12
        chosen = rng.randrange(len(chunks))
        content, what = mutate(chunks[chosen][1], rng)
        chunks[chosen] = chunks[chosen][0], content
        packed = [
            struct.pack(">I", len(body)) + kind + body + struct.pack(">I", zlib.crc32(kind + body))
            for kind, body in chunks
        ]
        return data[:8] + b"".join(packed), f"{chunks[chosen][0].decode()}, checksum right: {what}"

    return mutate_chunk
