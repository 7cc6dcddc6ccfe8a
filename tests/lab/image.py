"""Creates the boot files of the lab machine: a stock Debian kernel and a small initramfs.

Both are kept in the cache folder, under a name made of the kernel package's
version and a hash of this file and of `init`:

    6.1.0-56-amd64_6.1.192-2-0123456789ab/vmlinux          the bare ELF, entered by PVH
    6.1.0-56-amd64_6.1.192-2-0123456789ab/initramfs.cpio   busybox, modules, init
    linux-image-6.1.0-56-amd64_6.1.192-2_amd64.deb         as downloaded

A name is there only when what it names is complete: everything is made in
`making-*` and renamed.
"""

import contextlib
import fcntl
import hashlib
import lzma
import os
import shutil
import struct
import subprocess
import tempfile
from pathlib import Path

HERE = Path(__file__).resolve().parent
META_PACKAGE = "linux-image-amd64"

# Program -> the Debian package that has it.
NEEDED = {
    "qemu-system-x86_64": "qemu-system-x86",
    "busybox": "busybox-static",
    "depmod": "kmod",
    "candump": "can-utils",
    "ip": "iproute2",
    "dpkg-deb": "dpkg",
}

# The modules that `init` loads: the connection to the host, then CAN. `modules.dep` adds their dependencies.
MODULES = ["virtio_pci", "virtio_console", "9p", "9pnet_virtio",
           "can", "can-raw", "can-gw", "vcan", "vxcan", "kvaser_pci"]

SIGNATURE_END = b"~Module signature appended~\n"


class LabError(Exception):
    """One line for the user: what, its value, what is allowed, what to do."""


def which(program):
    """Like `shutil.which`, but also looks where a user's PATH often does not."""
    return shutil.which(program, path=os.environ.get("PATH", os.defpath) + ":/usr/sbin:/sbin")


def need_packages(say):
    """Installs the missing packages, or names them in one line."""
    missing = [package for program, package in NEEDED.items() if not which(program)]
    if not missing:
        return
    install = "apt-get install --no-install-recommends " + " ".join(missing)
    if not which("apt-get"):
        raise LabError(f"missing: {' '.join(missing)} (Debian's names); there is no apt-get here, "
                       "so install them by this system's own means")
    if os.geteuid() != 0:
        raise LabError(f"missing: {' '.join(missing)}; only root may install them, so run: sudo {install}")
    say(f"installing {' '.join(missing)}")
    apt_update(say)
    env = dict(os.environ, DEBIAN_FRONTEND="noninteractive")
    run([*install.split(), "-y", "-q"], f"cannot install {' '.join(missing)}; with a network, run by hand: {install}", env=env)
    if absent := [program for program in NEEDED if not which(program)]:
        raise LabError(f"installed {' '.join(missing)}, and still not in PATH: {' '.join(absent)}")


def apt_update(say):
    """A failed update is not yet an error: the old lists may suffice."""
    if os.geteuid() == 0:
        say("apt-get update")
        subprocess.run(["apt-get", "update", "-q"], stdin=subprocess.DEVNULL, capture_output=True, check=False)


def run(command, failed, **options):
    """Runs a command; `failed` and the command's own last line make the error."""
    done = subprocess.run(command, stdin=subprocess.DEVNULL, capture_output=True, text=True, check=False, **options)
    if done.returncode != 0:
        last = (done.stderr.strip() or done.stdout.strip() or "no output").splitlines()[-1]
        raise LabError(f"{failed} ({command[0]} exited {done.returncode}: {last})")
    return done.stdout


def image(cache, say):
    """The folder with `vmlinux` and `initramfs.cpio`; made now if it is not in the cache."""
    key = hashlib.sha256(b"\0".join((HERE / name).read_bytes() for name in ("image.py", "init"))).hexdigest()[:12]
    if made := newest(cache.glob(f"*-{key}")):
        return made
    with contextlib.ExitStack() as stack:
        cache.mkdir(parents=True, exist_ok=True)
        lock = stack.enter_context(open(cache / "lock", "w", encoding="ascii"))
        fcntl.flock(lock, fcntl.LOCK_EX)
        if made := newest(cache.glob(f"*-{key}")):
            return made
        for stale in cache.glob("making-*"):
            shutil.rmtree(stale)
        making = Path(stack.enter_context(tempfile.TemporaryDirectory(prefix="making-", dir=cache)))
        deb = kernel_package(cache, making, say)
        say(f"unpacking {deb.name}")
        run(["dpkg-deb", "-x", str(deb), str(making / "root")],
            f"cannot unpack {deb}; delete it, and it is downloaded again")
        ready = making / "image"
        ready.mkdir()
        vmlinuz = newest((making / "root/boot").glob("vmlinuz-*"))
        if not vmlinuz:
            raise LabError(f"{deb} has no /boot/vmlinuz-*; put Debian 12's linux-image-6.1.*-amd64 package there instead")
        (ready / "vmlinux").write_bytes(bare_elf(vmlinuz))
        (ready / "initramfs.cpio").write_bytes(initramfs(making / "root"))
        made = cache / f"{deb.name.removeprefix('linux-image-').removesuffix('_amd64.deb')}-{key}"
        ready.rename(made)
        images = sorted(cache.glob("*/vmlinux"), key=lambda path: path.parent.stat().st_mtime)
        for old in images[:-3]:             # one more with every edit of these scripts
            shutil.rmtree(old.parent, ignore_errors=True)
        return made


def newest(paths):
    """The path that was made last."""
    return max(paths, key=lambda path: path.stat().st_mtime, default=None)


def kernel_package(cache, making, say):
    """The kernel's package: the cached one, else Debian's current one."""
    cached = newest(cache.glob("linux-image-*.deb"))
    if cached:
        return cached
    missing = (f"the programs are installed, only the kernel is missing, as {cache} has no linux-image-*.deb; "
               "copy Debian 12's linux-image-6.1.*-amd64 package there, or try again")
    if not (which("apt-get") and which("apt-cache")):
        raise LabError(f"{missing} where there is apt")
    why = f"apt does not know {META_PACKAGE}"
    for attempt in range(2):
        if attempt == 1:                    # the lists may be missing, or older than the kernel there is
            apt_update(say)
        depends = subprocess.run(["apt-cache", "depends", META_PACKAGE], stdin=subprocess.DEVNULL,
                                 capture_output=True, text=True, check=False).stdout
        names = [line.split()[1] for line in depends.splitlines() if line.strip().startswith("Depends: linux-image-")]
        if not names:
            continue
        say(f"downloading {names[0]} (70 MB)")
        done = subprocess.run(["apt-get", "download", "-q", names[0]], cwd=making, stdin=subprocess.DEVNULL,
                              capture_output=True, text=True, check=False)
        if done.returncode == 0:
            deb = next(making.glob("linux-image-*.deb"))
            return deb.rename(cache / deb.name)
        why = (done.stderr.strip().splitlines() or ["no output"])[-1]
    raise LabError(f"{missing} with a network ({why})")


def bare_elf(vmlinuz):
    """The kernel inside a bzImage, so that nothing is unpacked under emulation.

    Offsets: the kernel's Documentation/x86/boot.rst.
    """
    image_bytes = vmlinuz.read_bytes()
    sectors = image_bytes[0x1F1]
    offset, length = struct.unpack_from("<II", image_bytes, 0x248)
    start = (sectors + 1) * 512 + offset
    payload = image_bytes[start:start + length]
    if payload[:6] != b"\xfd7zXZ\0":
        raise LabError(f"{vmlinuz.name} is packed as {payload[:6].hex()}, not as xz (fd377a585a00); "
                       "put Debian 12's linux-image-6.1.*-amd64 package into the cache folder instead")
    return lzma.LZMADecompressor().decompress(payload)


def initramfs(root):
    """A newc archive of busybox, the modules, and `init`."""
    busybox = Path(which("busybox")).read_bytes()
    if has_interpreter(busybox):
        raise LabError(f"{which('busybox')} is linked dynamically; it must be static: apt-get install busybox-static")
    tree = {"bin/busybox": busybox, "init": (HERE / "init").read_bytes()}
    modules = next((root / "lib/modules").iterdir())
    run([which("depmod"), "-b", str(root), modules.name], f"cannot work out what the modules of {modules.name} need")
    depends = {}
    for line in (modules / "modules.dep").read_text().splitlines():
        path, others = line.split(":")
        depends[path.split("/")[-1].split(".")[0].replace("-", "_")] = (path, others.split(), line)
    selected = set()
    for name in MODULES:
        if name.replace("-", "_") not in depends:
            raise LabError(f"the kernel {modules.name} has no module {name}; use a generic Debian kernel (-amd64), not a -cloud one")
        path, others, _ = depends[name.replace("-", "_")]
        selected |= {path, *others}
    for path in selected:
        tree[f"lib/modules/{modules.name}/{path}"] = unsigned((modules / path).read_bytes())
    kept = [line for path, _, line in depends.values() if path in selected]
    tree[f"lib/modules/{modules.name}/modules.dep"] = ("\n".join(kept) + "\n").encode()
    return cpio(tree)


def has_interpreter(elf):
    """True if a 64-bit ELF has a PT_INTERP program header, and so needs libraries to run."""
    (offset,) = struct.unpack_from("<Q", elf, 0x20)
    size, count = struct.unpack_from("<HH", elf, 0x36)
    return any(struct.unpack_from("<I", elf, offset + n * size) == (3,) for n in range(count))


def unsigned(module):
    """A module without its signature, which costs time in the virtual machine and is not enforced."""
    if not module.endswith(SIGNATURE_END):
        return module
    end = len(module) - len(SIGNATURE_END)
    (length,) = struct.unpack_from(">I", module, end - 4)
    return module[:end - 12 - length]


def cpio(tree):
    """A `newc` archive of executable files and their folders. Archives may follow one another."""
    folders = {str(parent) for path in tree for parent in Path(path).parents} - {"."}
    entries = [(name, 0o040755, b"") for name in sorted(folders)]
    entries += [(name, 0o100755, content) for name, content in tree.items()]
    entries.append(("TRAILER!!!", 0, b""))
    out = bytearray()
    for inode, (name, mode, content) in enumerate(entries, 1):
        raw = name.encode() + b"\0"
        fields = (inode, mode, 0, 0, 1, 0, len(content), 0, 0, 0, 0, len(raw), 0)
        out += b"070701" + b"".join(b"%08X" % field for field in fields) + raw
        out += bytes(-len(out) % 4) + content
        out += bytes(-len(out) % 4)
    return bytes(out)
