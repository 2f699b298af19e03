"""Digests of what the library computes: fits, files, decoders, renders, gradients, maps.

    python -m tests.golden.record                   write those of all cases to expected.json
    python -m tests.golden.record fit/ scene/edits  only of cases whose names start so
    python -m tests.golden.record --check [...]     name the values that differ instead (exit 1)

A digest is the first 16 digits of a SHA-256. Bits depend on the processor and on versions, which the file names.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import platform
import sys
from importlib.metadata import version
from pathlib import Path
from typing import Any

import llvmlite.binding as llvm
import torch
from torch import Tensor

from .cases import CASES

EXPECTED = Path(__file__).with_name("expected.json")
PACKAGES = (
    "torch", "numpy", "numba", "llvmlite", "scipy", "scikit-image", "constriction", "kornia",
    "onnx", "onnx-ir", "onnxruntime", "safetensors",
)  # fmt: skip
VECTOR_FEATURES = ("fma", "avx2", "avx512f", "avx512vl")


def describe_platform() -> dict[str, str]:
    """Name what the bits depend on."""
    cpu = Path("/proc/cpuinfo")
    models = [line for line in cpu.read_text().splitlines() if line.startswith("model name")] if cpu.exists() else []
    features = llvm.get_host_cpu_features()
    vectors = " ".join(name for name in VECTOR_FEATURES if features.get(name))
    return {
        "system": f"{platform.system()} {platform.machine()}, Python {platform.python_version()}",
        "processor": models[0].partition(":")[2].strip() if models else platform.processor(),
        "torch instructions": torch.backends.cpu.get_cpu_capability(),
        "numba instructions": f"{llvm.get_host_cpu_name()}, {vectors or 'no vectors'}",
    } | {name: version(name) for name in PACKAGES}


def compute(name: str) -> dict[str, str]:
    """Run a case on one thread; return its digests."""
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        return digest(CASES[name]())
    finally:
        torch.set_num_threads(threads)


def digest(value: Any, name: str = "") -> dict[str, str]:
    """Return the digest of every tensor, file and value in nested dictionaries, by name."""
    if not isinstance(value, dict):
        return {name: hashlib.sha256(_to_bytes(value)).hexdigest()[:16]}
    digests: dict[str, str] = {}
    for key, part in value.items():
        digests |= digest(part, f"{name}.{key}" if name else key)
    return digests


def _to_bytes(value: Any) -> bytes:
    if isinstance(value, bytes):
        return value
    if isinstance(value, Tensor):
        value = value.detach()
        value = value.nan_to_num(nan=-12345.0) if value.is_floating_point() else value.long()
        return f"{value.dtype} {tuple(value.shape)} ".encode() + value.contiguous().numpy().tobytes()
    if isinstance(value, list | tuple):
        return b"[" + b",".join(map(_to_bytes, value)) + b"]"
    return (value.hex() if isinstance(value, float) else repr(value)).encode()


def differences(name: str, expected: dict[str, str]) -> list[str]:
    """Run a case; return the names of the values that differ."""
    digests = compute(name)
    return sorted(key for key in digests.keys() | expected.keys() if digests.get(key) != expected.get(key))


def write(names: list[str], digests: dict[str, dict[str, str]]) -> None:
    """Write the digests of these cases, and keep those of the others."""
    digests |= {name: compute(name) for name in names}
    lines = [f"  {json.dumps(name)}: {json.dumps(digests[name])}" for name in CASES]
    described = json.dumps(describe_platform(), indent=1).replace("\n", "\n ")
    EXPECTED.write_text(f'{{\n "platform": {described},\n "digests": {{\n' + ",\n".join(lines) + "\n }\n}\n")


def main(*arguments: str) -> int:
    """Run the command; return the exit status."""
    parser = argparse.ArgumentParser("python -m tests.golden.record")
    parser.add_argument("prefixes", nargs="*", default=[""], metavar="PREFIX", help="of names of cases; default: all")
    parser.add_argument("--check", action="store_true", help="write nothing; name the values that differ")
    options = parser.parse_args(arguments)
    names = [name for name in CASES if name.startswith(tuple(options.prefixes))]
    digests = json.loads(EXPECTED.read_text())["digests"]
    if not options.check:
        write(names, digests)
        return 0
    changes = {name: values for name in names if (values := differences(name, digests.get(name, {})))}
    for name, values in changes.items():
        print(f"{name}: {', '.join(values)}")
    print(f"{len(names) - len(changes)} of {len(names)} cases are the same")
    return int(bool(changes))


if __name__ == "__main__":
    sys.exit(main(*sys.argv[1:]))
