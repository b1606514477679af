"""Wheels of other machines, built here: a wheel with a wrong library, too much or too little is refused."""

import os
import re
import runpy
import struct
import subprocess
import zipfile
from hashlib import sha256
from pathlib import Path

import pytest
import yaml

from camtorch.native import build as building
from camtorch.native import structs
from camtorch.native.structure import offsets

ROOT = Path(__file__).parents[2]
X86, ARM, MAC, WINDOWS = "manylinux_2_17-x86_64", "manylinux_2_17-aarch64", "macosx-11.0-arm64", "win-amd64"


@pytest.fixture
def wheels(monkeypatch):
    monkeypatch.syspath_prepend(ROOT / ".ci")
    import wheels

    return wheels


def signed(content, oldest=11):
    """A library for macOS with a signature of its content, in pages of 4096 bytes."""
    end = 32 + 24 + 16 + len(content)
    head = b"\xcf\xfa\xed\xfe\x0c\0\0\x01" + struct.pack("<6I", 0, 6, 2, 40, 0, 0)
    head += struct.pack("<6I", 0x32, 24, 1, oldest << 16, 0, 0) + struct.pack("<4I", 0x1D, 16, end, 0)
    pages = [(head + content)[begin : begin + 4096] for begin in range(0, end, 4096)]
    directory = struct.pack(">9I4B", 0xFADE0C02, 0, 0, 2, 44, 0, 0, len(pages), end, 32, 2, 0, 12) + bytes(4)
    blob = struct.pack(">5I", 0xFADE0CC0, 0, 1, 0, 20)
    return head + content + blob + directory + b"".join(sha256(page).digest() for page in pages)


def library(target, needs=b"GLIBC_2.17\0", numbers=None):
    """The bytes of a library as `check_library` reads them: header, names of its calls, checksums."""
    numbers = numbers or [building.checksum(), structs.CHECKSUM, *offsets(structs.STRUCTS)]
    content = b"".join(name.encode() + b"\0" for name in structs.Library.__annotations__) + struct.pack(
        f"<{len(numbers)}I", *numbers
    )
    content += needs + bytes(9000)
    if target == MAC:
        return signed(content)
    if target == WINDOWS:
        return b"MZ" + bytes(118) + b"PE\0\0\x64\x86" + content
    return b"\x7fELF\x02\x01" + bytes(12) + (b"\x3e\0" if target == X86 else b"\xb7\0") + content


@pytest.mark.parametrize(
    ("target", "needs", "system"),
    [
        (X86, b"\0libm.so.6\0GLIBC_2.14\0GLIBC_2.2.5\0", "glibc 2.14"),
        (ARM, b"\0libc.so.6\0GLIBC_2.17\0", "glibc 2.17"),
        (MAC, b"/usr/lib/libSystem.B.dylib\0", "macOS 11"),
        (WINDOWS, b"KERNEL32.dll\0api-ms-win-crt-math-l1-1-0.dll\0", "Windows 10"),
    ],
)
def test_a_library_of_each_kind_of_machine_is_known(wheels, target, needs, system):
    assert wheels.check_library(target, library(target, needs), ROOT) == system
    for other in wheels.TARGETS.keys() - {target}:
        with pytest.raises(ValueError, match="must have the header of"):
            wheels.check_library(other, library(target, needs), ROOT)


@pytest.mark.parametrize(
    ("target", "changed", "message"),
    [
        (X86, {"needs": b"GLIBC_2.2.5\0GLIBC_2.35\0"}, "no symbol newer than glibc 2.17; got 2.35"),
        (ARM, {"needs": b"GLIBC_2.18\0"}, "no symbol newer than glibc 2.17; got 2.18"),
        (ARM, {"needs": b"GLIBC_2.17\0libgomp.so.1\0"}, "libraries that a system may lack; got {b'libgomp.so.1'}"),
        (WINDOWS, {"needs": b"libgcc_s_seh-1.dll\0"}, "libgcc_s_seh-1.dll"),
        (MAC, {"needs": b"/opt/homebrew/libomp.dylib\0"}, "libomp.dylib"),
        (X86, {"numbers": [1, 2, 3]}, "the checksums and the layout"),
    ],
)
def test_a_library_that_would_not_load_or_be_used_is_refused(wheels, target, changed, message):
    with pytest.raises(ValueError, match=re.escape(message)):
        wheels.check_library(target, library(target, **changed), ROOT)


def test_calls_that_are_not_in_it_are_named(wheels):
    with pytest.raises(ValueError, match=r"all calls; it lacks \['camtorch_lay'\]"):
        wheels.check_library(X86, library(X86).replace(b"camtorch_lay\0", b"camtorch_led\0"), ROOT)


def test_macos_needs_a_signature_of_what_is_there(wheels):
    data = library(MAC)
    at = data.index(bytes(5000)) + 100
    with pytest.raises(ValueError, match="an ad-hoc signature of all that is before it"):
        wheels.check_library(MAC, data[:at] + b"1" + data[at + 1 :], ROOT)
    with pytest.raises(ValueError, match="LC_CODE_SIGNATURE"):
        wheels.check_library(MAC, data.replace(struct.pack("<2I", 0x1D, 16), struct.pack("<2I", 0x1E, 16)), ROOT)
    with pytest.raises(ValueError, match="no need of more than macOS 11; got 12"):
        wheels.check_signature("one", signed(b"", oldest=12))


@pytest.fixture(scope="module")
def listed():
    done = subprocess.run(["git", "ls-files", "camtorch"], cwd=ROOT, capture_output=True, text=True)
    if done.returncode:
        pytest.skip("this is no repository")
    return done.stdout.splitlines()


def test_a_wheel_has_camtorch_and_one_library(wheels, listed, tmp_path):
    def wheel(tag, **files):
        path = tmp_path / f"camtorch-1.0-py3-none-{tag}.whl"
        with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
            archive.writestr("camtorch-1.0.dist-info/METADATA", "Name: camtorch\n")
            for name in listed:
                if name not in files:
                    archive.write(ROOT / name, name)
            for name, content in files.items():
                if content is not None:
                    archive.writestr(name, content)
        return path

    native = "camtorch/native/_sampler"
    right = {f"{native}.aarch64.so": library(ARM)}
    assert wheels.check(wheel("manylinux_2_17_aarch64", **right)) == "glibc 2.17"
    assert wheels.check(wheel("any", **{f"{native}.reason.txt": "none"})) == "no library"
    for tag, files, message in [
        ("any", right, "must have no library; got ['_sampler.aarch64.so']"),
        ("manylinux_2_17_x86_64", right, "must have _sampler.x86_64.so; got ['_sampler.aarch64.so']"),
        ("win_amd64", {}, "must have _sampler.amd64.dll; got []"),
        ("manylinux_2_17_aarch64", {**right, "tests/a.py": ""}, "only files of camtorch, with names of ASCII; got"),
        ("manylinux_2_17_aarch64", {**right, "camtorch/py.typed": None}, "it lacks ['camtorch/py.typed']"),
        ("manylinux_2_17_aarch64", {**right, "camtorch/big": os.urandom(2_000_000)}, "at most 2725000 bytes; got"),
    ]:
        with pytest.raises(ValueError, match=re.escape(message)):
            wheels.check(wheel(tag, **files))


def test_a_build_for_another_machine_has_its_names_and_options(wheels, monkeypatch):
    for target, (_, library, *_) in wheels.TARGETS.items():
        monkeypatch.setenv("_PYTHON_HOST_PLATFORM", target)
        made = runpy.run_path(building.__file__)
        assert made["LIBRARY"] == library
        assert ("avx2" in made["VARIANTS"]) == library.endswith(("x86_64.so", "amd64.dll"))
        assert ("-fPIC" in made["_FLAGS"]) == (not library.endswith("dll"))


def test_every_wheel_is_loaded_on_its_system_before_it_is_published(wheels):
    text = (ROOT / ".github" / "workflows" / "wheels.yml").read_text("utf-8")
    tried = yaml.safe_load(text)["jobs"]["load"]["strategy"]["matrix"]["include"]
    assert sorted(one["wheel"] for one in tried) == sorted(map(wheels.tag, wheels.TARGETS))


@pytest.mark.slow  # it takes a network, and a minute
def test_one_command_builds_a_wheel_for_another_machine(tmp_path):
    environment = os.environ | {"DIST": str(tmp_path), "CC": "no-such-compiler"}
    done = subprocess.run(["bash", ROOT / ".ci/wheels", "arm64"], env=environment, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    assert re.fullmatch(
        r"camtorch-\S+-macosx_11_0_arm64.whl: [\d.]+ MB; macOS 11; release.yml publishes it .*\n", done.stdout
    )
