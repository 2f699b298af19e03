"""Keep digests of what the library computes, and compare: fits, files, decoders, renders, gradients, maps.

    python tests/golden/record.py --check [NAME...]     which cases differ from expected.json (exit 1)
    python tests/golden/record.py --check --only fit/   those of a group
    python tests/golden/record.py                       write expected.json anew

A digest is the first 16 digits of a SHA-256. Bits depend on processor and versions, which the file names.
"""

from __future__ import annotations

import os

if __name__ == "__main__":  # before torch and numba start
    for _variable in ("OMP_NUM_THREADS", "NUMBA_NUM_THREADS", "MKL_NUM_THREADS"):
        os.environ[_variable] = "1"

import argparse
import hashlib
import json
import platform
import sys
import time
from importlib.metadata import version
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

sys.path.insert(0, str(Path(__file__).parent))
from cases import CASES

EXPECTED = Path(__file__).with_name("expected.json")
_PACKAGES = ("torch", "numpy", "numba", "llvmlite", "scipy", "scikit-image", "constriction", "kornia")
_FILE_PACKAGES = ("onnx", "onnx-ir", "onnxruntime", "safetensors")


def describe_platform() -> dict[str, str]:
    """Name what the bits depend on."""
    import llvmlite.binding as llvm

    cpu = Path("/proc/cpuinfo")
    models = [line for line in cpu.read_text().splitlines() if line.startswith("model name")] if cpu.exists() else []
    return {
        "system": f"{platform.system()} {platform.machine()}, Python {platform.python_version()}",
        "processor": models[0].partition(":")[2].strip() if models else platform.processor(),
        "torch instructions": torch.backends.cpu.get_cpu_capability(),
        "numba instructions": f"{llvm.get_host_cpu_name()}, {_wide_vectors(llvm.get_host_cpu_features())}",
    } | {name: version(name) for name in (*_PACKAGES, *_FILE_PACKAGES)}


def _wide_vectors(features: Any) -> str:
    return " ".join(name for name in ("fma", "avx2", "avx512f", "avx512vl") if features.get(name)) or "no vectors"


def digest(value: Any, name: str = "") -> dict[str, str]:
    """Return the digest of every tensor, file and value in nested dictionaries, by name."""
    if isinstance(value, dict):
        found: dict[str, str] = {}
        for key, part in value.items():
            found |= digest(part, f"{name}.{key}" if name else key)
        return found
    return {name: hashlib.sha256(_to_bytes(value)).hexdigest()[:16]}


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


def compute(name: str) -> dict[str, str]:
    """Run a case on one thread."""
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        return digest(CASES[name]())
    finally:
        torch.set_num_threads(threads)


def differences(name: str, expected: dict[str, str]) -> list[str]:
    """Run a case and return the names of the values that differ."""
    found = compute(name)
    return sorted(key for key in found.keys() | expected.keys() if found.get(key) != expected.get(key))


def chosen(names: list[str], prefix: str) -> list[str]:
    """Return the cases of these names (none: all) and this prefix."""
    unknown = [name for name in names if name not in CASES]
    if unknown:
        raise SystemExit(f"no such cases: {', '.join(unknown)}; there are {', '.join(CASES)}")
    return [name for name in CASES if name.startswith(prefix) and (not names or name in names)]


def check(names: list[str]) -> int:
    """Print which cases differ; return the exit status."""
    kept = json.loads(EXPECTED.read_text())
    here = describe_platform()
    if here != kept["platform"]:
        other = {key: (value, here.get(key)) for key, value in kept["platform"].items() if here.get(key) != value}
        print(f"recorded on another platform, so bits may differ: {other}", file=sys.stderr)
    failed = 0
    for name in names:
        try:
            different = differences(name, kept["digests"].get(name, {}))
        except Exception as error:  # a case that no longer runs is one that differs
            different = [f"{type(error).__name__}: {' '.join(str(error).split())}"]
        if different:
            failed += 1
            print(f"{name}: {', '.join(different)}")
    print(f"{len(names) - failed} of {len(names)} cases are the same", file=sys.stderr)
    return int(failed > 0)


def record(names: list[str], slow: bool) -> int:
    """Write the digests of these cases; the others stay."""
    kept = json.loads(EXPECTED.read_text())["digests"] if EXPECTED.exists() else {}
    for name in names:
        start = time.perf_counter()
        kept[name] = compute(name)
        if slow:
            print(f"{time.perf_counter() - start:6.2f} s  {name}", file=sys.stderr)
    lines = [f"  {json.dumps(name)}: {json.dumps(kept[name])}" for name in CASES if name in kept]
    where = json.dumps(describe_platform(), indent=1).replace("\n", "\n ")
    EXPECTED.write_text(f'{{\n "platform": {where},\n "digests": {{\n' + ",\n".join(lines) + "\n }\n}\n")
    return 0


def main() -> int:
    """Run the command."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("names", nargs="*", metavar="NAME")
    parser.add_argument("--check", action="store_true", help="compare, write nothing")
    parser.add_argument("--only", default="", metavar="PREFIX", help="cases whose names start so")
    parser.add_argument("--times", action="store_true", help="print how long each took")
    args = parser.parse_args()
    names = chosen(args.names, args.only)
    return check(names) if args.check else record(names, args.times)


if __name__ == "__main__":
    sys.exit(main())
