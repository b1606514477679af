"""Builds the wheel of each platform, and looks into it, for `.ci/wheels`.

One Linux machine builds them all. ziglang compiles, but for Linux on a machine like this one its own compiler does, if
it has one: gcc's code for x86 is quicker. A library for another system is not tried here, and may crash there. So
release.yml publishes its wheel only if a machine of that system has loaded it and passed the tests; else pip takes the
wheel "any" there, which has no library. If both are there, pip prefers the one that names the machine.
"""

import importlib.util
import os
import platform
import re
import shlex
import shutil
import struct
import subprocess
import sys
import tempfile
import zipfile
from hashlib import sha256
from pathlib import Path
from typing import NamedTuple

ROOT = Path(__file__).resolve().parent.parent
COLLECTION = "camtorch/lenses/gyroflow.npz"
LIMITS = {"camtorch": 930_000, COLLECTION: 680_000}
"""Bytes of a wheel without a library: of all but the collection, and of the collection, which is 9 numbers of 9,810
lenses to the bit. Six of the eight bytes of each are noise, 0.53 MB that nothing makes smaller."""
LIMIT = 2_725_000  # bytes of a wheel with a library


class Target(NamedTuple):
    """A kind of machine: zig's name for it, the library's name there, how it begins, and what it loads."""

    zig: str
    library: str
    begins: bytes
    loads: bytes


# by _PYTHON_HOST_PLATFORM, from which hatch_build.py makes a wheel's tag. glibc 2.17 is older than that of every Linux
# that torch runs on
TARGETS = {
    "manylinux_2_17-x86_64": Target(
        zig="x86_64-linux-gnu.2.17",
        library="_sampler.x86_64.so",
        begins=rb"\x7fELF\x02\x01.{12}\x3e\0",
        loads=rb"lib[cm]\.so\.6|ld-linux-x86-64\.so\.2",
    ),
    "manylinux_2_17-aarch64": Target(
        zig="aarch64-linux-gnu.2.17",
        library="_sampler.aarch64.so",
        begins=rb"\x7fELF\x02\x01.{12}\xb7\0",
        loads=rb"lib[cm]\.so\.6|ld-linux-aarch64\.so\.1",
    ),
    "macosx-11.0-arm64": Target(
        zig="aarch64-macos.11.0",
        library="_sampler.arm64.dylib",
        begins=rb"\xcf\xfa\xed\xfe\x0c\0\0\x01",
        loads=rb"/usr/lib/libSystem\.B\.dylib|_sampler\.arm64\.dylib",
    ),
    "win-amd64": Target(
        zig="x86_64-windows-gnu",
        library="_sampler.amd64.dll",
        begins=rb"MZ.{62,500}?PE\0\0\x64\x86",
        loads=rb"kernel32\.dll|api-ms-win-crt-[\w-]+\.dll|_sampler\.amd64\.dll",
    ),
}
# printed by the Python code of a wheel: what it compares with its library at load, and the calls that it makes
_EXPECTED = """
from camtorch.native import build, structs, structure
print(build.checksum(), structs.CHECKSUM, *structure.offsets(structs.STRUCTS))
print(*structs.Library.__annotations__)
"""


def run(*words: str | Path, cwd: Path = ROOT, **environment: str) -> str:
    """Run a command, and give what it prints; where it fails, show that and end."""
    done = subprocess.run(words, cwd=cwd, env=os.environ | environment, capture_output=True, text=True)
    if done.returncode:
        sys.exit(f"{' '.join(map(str, words))}\n{done.stdout}{done.stderr}")
    return done.stdout


def compiler() -> str | None:
    """Return the C compiler of this machine, or None if it has none."""
    return os.environ.get("CC") or next(filter(shutil.which, ("cc", "gcc", "clang")), None)


def own() -> str:
    """Return the target that this machine is, or "" if it is of another kind."""
    name = f"manylinux_2_17-{platform.machine()}"
    return name if platform.system() == "Linux" and name in TARGETS else ""


def tag(target: str) -> str:
    """Return the end of the name of a target's wheel."""
    return re.sub("[-.]", "_", target)


def build(archive: Path, target: str, folder: Path) -> Path:
    """Build the wheel of a target from the archive of sources; "any" has no library, "" is for this machine."""
    environment = {"CAMTORCH_NATIVE": "0" if target == "any" else "1"}
    if target in TARGETS:
        environment |= {"_PYTHON_HOST_PLATFORM": target, "CC": f"{compiler()} -s"}
        if target != own() or compiler() is None:
            # by its path, as pip hides packages from what it runs
            found = importlib.util.find_spec("ziglang")
            if found is None or found.origin is None:
                sys.exit("pip install ziglang, which compiles for other machines")
            zig = shlex.quote(str(Path(found.origin).with_name("zig")))
            environment["CC"] = f"{zig} cc -target {TARGETS[target].zig} -g0 -s"
    with tempfile.TemporaryDirectory() as work:
        # pip keeps a wheel by the name of its archive alone, whatever the environment asked for
        words = ("wheel", "--quiet", "--no-deps", "--no-cache-dir", archive, "--wheel-dir", work)
        run(sys.executable, "-m", "pip", *words, cwd=Path(work), **environment)
        (made,) = Path(work).glob("*.whl")
        if target and not made.name.endswith(f"-{tag(target)}.whl"):
            with zipfile.ZipFile(made) as file:
                sys.exit(f"{target}: {file.read('camtorch/native/_sampler.reason.txt').decode()}")
        return compressed(made, folder)


def compressed(wheel: Path, folder: Path) -> Path:
    """Write a wheel into a folder, compressed as far as zip can, by which it is four kilobytes smaller; return it."""
    made = folder / wheel.name
    with zipfile.ZipFile(wheel) as given, zipfile.ZipFile(made, "w") as file:
        for member in given.infolist():
            file.writestr(member, given.read(member), member.compress_type, 9)
    return made


def check(path: Path) -> str:
    """Return the system that a wheel needs; raise a ValueError if it has too much, too little, or a wrong library."""
    with zipfile.ZipFile(path) as file, tempfile.TemporaryDirectory() as made:
        held = {member.filename: member.compress_size for member in file.infolist() if not member.is_dir()}
        metadata = next(file.read(name).decode() for name in held if name.endswith(".dist-info/METADATA"))
        compiled = [Path(name).name for name in held if "/_sampler." in name]
        target = next((name for name in TARGETS if path.name.endswith(f"-{tag(name)}.whl")), "")
        foreign = [name for name in held if not re.match(r"camtorch(/|-[\w.]+\.dist-info/)[ -~]+$", name)]
        expect(not foreign, path, f"only files of camtorch, with names of ASCII; got {foreign}")
        expect("](docs/" not in metadata, path, "links that an index of packages can follow")
        if (ROOT / ".git").exists():
            lost = set(run("git", "ls-files", "camtorch").splitlines()) - set(held)
            expect(not lost, path, f"all files of the repository; it lacks {sorted(lost)}")
        if path.name.endswith("-any.whl"):
            sizes = {"camtorch": path.stat().st_size - held[COLLECTION], COLLECTION: held[COLLECTION]}
            expect(all(sizes[name] <= LIMITS[name] for name in sizes), path, f"at most {LIMITS} bytes; got {sizes}")
            expect(compiled == ["_sampler.reason.txt"], path, f"no library; got {compiled}")
            return "no library"
        expect(path.stat().st_size <= LIMIT, path, f"at most {LIMIT} bytes; got {path.stat().st_size}")
        if not target:
            return "its library was not looked into"
        expect(compiled == [TARGETS[target].library], path, f"{TARGETS[target].library}; got {compiled}")
        file.extractall(made)
        return check_library(target, Path(made, "camtorch", "native", compiled[0]).read_bytes(), Path(made))


def check_library(target: str, data: bytes, folder: Path) -> str:
    """Return the system that a library needs, or raise a ValueError; the folder has the camtorch that loads it."""
    _, library, begins, loads = TARGETS[target]
    expect(re.match(begins, data, re.S), library, f"the header of {target}; got {data[:24]!r}")
    named = set(re.findall(rb"[\w/.+-]+\.(?:dll|dylib|so\.\d+)\b", data))
    others = {name for name in named if not re.fullmatch(loads, name, re.I)}
    expect(not others, library, f"no need of libraries that a system may lack; got {others}")
    printed = run(sys.executable, "-B", "-c", _EXPECTED, cwd=folder, PYTHONPATH=str(folder)).splitlines()
    numbers, calls = map(int, printed[0].split()), printed[1].split()
    row = b"".join(number.to_bytes(4, "little") for number in numbers)
    expect(row in data, library, "the checksums and the layout of its wheel's code")
    missing = [name for name in calls if name.encode() + b"\0" not in data]
    expect(not missing, library, f"all calls; it lacks {missing}")
    if target.startswith("macosx"):
        return check_signature(library, data)
    if target.startswith("win"):
        return "Windows 10"  # whose part is the C library of all these names
    most = tuple(map(int, re.findall(r"\d+", target)[:2]))
    needed = max((int(major), int(minor)) for major, minor in re.findall(rb"\bGLIBC_(\d+)\.(\d+)", data))
    expect(needed <= most, library, f"no symbol newer than glibc {most[0]}.{most[1]}; got {needed[0]}.{needed[1]}")
    return f"glibc {needed[0]}.{needed[1]}"


def check_signature(library: str, data: bytes) -> str:
    """Return the macOS that a library needs; raise a ValueError if it is not signed, as arm64 does not load it then."""
    commands, at = dict[int, list[int]](), 32
    for _ in range(struct.unpack_from("<I", data, 16)[0]):
        command, size, *commands[command] = struct.unpack_from("<4I", data, at)
        at += size
    oldest = commands[0x32][1] >> 16  # LC_BUILD_VERSION
    expect(oldest <= 11, library, f"no need of more than macOS 11; got {oldest}")
    expect(0x1D in commands, library, "LC_CODE_SIGNATURE")
    blob = commands[0x1D][0]
    directory = blob + struct.unpack_from(">I", data, blob + 16)[0]
    _, _, _, flags, hashes, _, _, count, end = struct.unpack_from(">9I", data, directory)
    page = 1 << data[directory + 39]
    pages = b"".join(sha256(data[begin : min(begin + page, end)]).digest() for begin in range(0, end, page))
    signed = data[directory + hashes : directory + hashes + 32 * count] == pages
    expect(flags & 2 and end == blob and signed, library, "an ad-hoc signature of all that is before it")
    return f"macOS {oldest}"


def expect(condition: object, owner: Path | str, wanted: str) -> None:
    """Raise a ValueError if a condition does not hold."""
    if not condition:
        raise ValueError(f"{owner.name if isinstance(owner, Path) else owner} must have {wanted}")


def main(words: list[str], folder: Path) -> None:
    """Build and check the wheels of the targets that have one of the words, or of all."""
    targets = [name for name in ("any", *TARGETS) if not words or any(word in name.split("-") for word in words)]
    if not targets:
        sys.exit(f"TARGET must be a word of {', '.join(('any', *TARGETS))}; got {' '.join(words)}")
    folder.mkdir(parents=True, exist_ok=True)
    run(sys.executable, "-m", "build", "--sdist", "--outdir", folder)
    archive = max(folder.glob("*.tar.gz"), key=os.path.getmtime)
    for target in targets:
        wheel = build(archive, target, folder)
        elsewhere = target != "any" and "linux" not in target
        may = "release.yml publishes it if it loads there" if elsewhere else "may be published"
        print(f"{wheel.name}: {wheel.stat().st_size / 1e6:.2f} MB; {check(wheel)}; {may}", flush=True)


if __name__ == "__main__":
    main(sys.argv[1:], Path(os.environ.get("DIST", "dist")).resolve())
