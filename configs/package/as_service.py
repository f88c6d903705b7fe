#!/usr/bin/python3
"""Run a command under the restrictions of the systemd unit, where no systemd runs.

    sudo configs/package/as_service.py [--write FOLDER]... [--user NAME|UID:GID] COMMAND ARGUMENT...

Reads configs/companion.service and applies of it what a process may be given without systemd: its
own view of the file system (ProtectSystem, ProtectHome, PrivateTmp, ReadWritePaths), its folders
and environment, devices (DevicePolicy, DeviceAllow), system calls, address families and namespaces
(a seccomp filter of the sets that systemd-analyze knows), no capabilities, no new privileges,
memory (MemoryMax, by cgroup v1), umask. It says on standard error what it applied and what not,
then becomes the command, so that signals reach it. Needs root, python3-seccomp and systemd-analyze.
"""

import argparse
import ctypes
import errno
import os
import pwd
import re
import socket
import subprocess
import sys
from pathlib import Path

import seccomp

_UNIT = Path(__file__).parents[1] / "companion.service"
_NEW_MOUNTS, _NEW_IPC = 0x00020000, 0x08000000
_NAMESPACES = 0x7E020080  # every CLONE_NEW* flag
_BY_SYSTEMD_ONLY = (
    "ProtectProc", "ProtectClock", "ProtectControlGroups", "ProtectHostname", "RemoveIPC",
    "OOMScoreAdjust", "Nice", "WatchdogSec", "SystemCallArchitectures",
)  # fmt: skip
_CLOSED = ("null", "zero", "full", "random", "urandom", "ptmx", "tty")


def settings(unit):
    """Key to the list of its values, of the section Service."""
    found, inside = {}, False
    for line in unit.read_text(encoding="utf-8").splitlines():
        if line.startswith("["):
            inside = line.strip() == "[Service]"
        elif inside and "=" in line and not line.startswith("#"):
            key, value = line.split("=", 1)
            found.setdefault(key.strip(), []).append(value.strip())
    return found


def mount(*words):
    """As mount(8)."""
    subprocess.run(["mount", *map(str, words)], check=True)


def narrow_files(unit, writable):
    """This process's own view: nothing can be written but what the unit says."""
    libc = ctypes.CDLL(None, use_errno=True)
    if libc.unshare(_NEW_MOUNTS | _NEW_IPC) != 0:
        sys.exit(f"as_service.py: no namespace of its own: {os.strerror(ctypes.get_errno())}")
    mount("--make-rprivate", "/")
    if unit["ProtectSystem"] == ["strict"]:
        mount("--rbind", "/", "/")
        for line in sorted(Path("/proc/self/mounts").read_text().splitlines(), key=len):
            target = line.split()[1].encode().decode("unicode_escape")
            if not target.startswith(("/dev", "/proc")):
                subprocess.run(["mount", "-o", "remount,bind,ro", target], stderr=-3, check=False)
    for folder in writable:
        mount("--bind", folder, folder)
        mount("-o", "remount,bind,rw", folder)
    kept = [folder.resolve() for folder in writable]
    hidden = ["/home", "/root"] if unit["ProtectHome"] == ["yes"] else []
    hidden += ["/tmp", "/var/tmp"] if unit["PrivateTmp"] == ["yes"] else []
    for folder in hidden:
        if any(Path(folder) in path.parents for path in kept):
            sys.exit(f"as_service.py: --write may not lie below {folder}, which is private")
        mount("-t", "tmpfs", "-o", "mode=1777", "private", folder)


def narrow_devices(unit):
    """A /dev with the pseudo devices and those of DeviceAllow that are there."""
    majors = {}
    for line in Path("/proc/devices").read_text().split("Block")[0].splitlines():
        if line.strip() and line.strip()[0].isdigit():
            number, name = line.split()
            majors.setdefault(name, set()).add(int(number))
    allowed = {value.split()[0].removeprefix("char-") for value in unit["DeviceAllow"]}
    numbers = {number for name in allowed for number in majors.get(name, ())}
    kept = [
        (path, path.stat())
        for path in Path("/dev").iterdir()
        if path.is_char_device()
        and (path.name in _CLOSED or os.major(path.stat().st_rdev) in numbers)
    ]
    mount("-t", "tmpfs", "-o", "mode=755,nosuid", "devices", "/dev")
    for path, status in kept:
        os.mknod(path, status.st_mode, status.st_rdev)
        os.chown(path, status.st_uid, status.st_gid)
        path.chmod(status.st_mode & 0o777)
    Path("/dev/shm").mkdir(mode=0o1777)  # numba's and Python's semaphores
    Path("/dev/shm").chmod(0o1777)
    for name, target in (("fd", "/proc/self/fd"), ("stdin", "/proc/self/fd/0"),
                         ("stdout", "/proc/self/fd/1"), ("stderr", "/proc/self/fd/2")):  # fmt: skip
        os.symlink(target, f"/dev/{name}")


def limit_memory(unit):
    """A cgroup (v1) of its own with the unit's limit; False where there is none."""
    group = Path("/sys/fs/cgroup/memory/companion-as-service")
    size = unit["MemoryMax"][0]
    try:
        group.mkdir(exist_ok=True)
        (group / "memory.limit_in_bytes").write_text(size)
        (group / "cgroup.procs").write_text(str(os.getpid()))
    except OSError:
        return False
    return True


def calls(names):
    """System calls of systemd's sets, which may name further sets."""
    found, waiting = set(), list(names)
    while waiting:
        name = waiting.pop()
        if not name.startswith("@"):
            found.add(name)
            continue
        text = subprocess.run(
            ["systemd-analyze", "syscall-filter", name], capture_output=True, text=True, check=True
        ).stdout
        waiting += re.findall(r"^\s+(@?[a-z0-9_-]+)$", text, re.M)
    return found


def narrow_calls(unit):
    """Load the filter; from here on only what a service may call is left."""
    wanted, refused = [], []
    for value in unit["SystemCallFilter"]:
        (refused if value.startswith("~") else wanted).extend(value.lstrip("~").split())
    left = calls(wanted) - calls(refused)
    # Their arguments are looked at; clone3 hides them in memory, and libc then takes clone.
    looked_at = {
        "socket",
        "clone",
        "clone3",
        "unshare",
        "setns",
        "personality",
        "sched_setscheduler",
    }
    told = seccomp.SyscallFilter(seccomp.ERRNO(errno.EPERM))
    for name in sorted(left - looked_at):
        try:
            told.add_rule(seccomp.ALLOW, name)
        except RuntimeError:
            continue  # not a call of this architecture
    for family in unit["RestrictAddressFamilies"][0].split():
        number = getattr(socket, family)
        told.add_rule(seccomp.ALLOW, "socket", seccomp.Arg(0, seccomp.EQ, number))
    told.add_rule(seccomp.ALLOW, "clone", seccomp.Arg(0, seccomp.MASKED_EQ, _NAMESPACES, 0))
    told.add_rule(seccomp.ERRNO(errno.ENOSYS), "clone3")
    for policy in (0, 3, 5):  # SCHED_OTHER, SCHED_BATCH, SCHED_IDLE: RestrictRealtime
        told.add_rule(seccomp.ALLOW, "sched_setscheduler", seccomp.Arg(1, seccomp.EQ, policy))
    told.load()


def main():
    """Apply, say so, and become the command."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n\n")[0])
    parser.add_argument("--write", type=Path, action="append", default=[], help="ReadWritePaths")
    parser.add_argument("--user", default="companion", help="name, or UID:GID")
    parser.add_argument("command", nargs=argparse.REMAINDER)
    options = parser.parse_args()
    if not options.command:
        parser.error("which command?")
    unit = settings(_UNIT)
    if ":" in options.user:
        uid, gid = map(int, options.user.split(":"))
        groups = [gid]
    else:
        entry = pwd.getpwnam(options.user)
        uid, gid = entry.pw_uid, entry.pw_gid
        groups = os.getgrouplist(options.user, gid)
    for parent, key in (("/var/lib", "StateDirectory"), ("/var/cache", "CacheDirectory")):
        folder = Path(parent, unit[key][0])
        folder.mkdir(exist_ok=True)
        options.write.append(folder)
    for folder in options.write:
        os.chown(folder, uid, gid)
    os.environ.update(word.split("=", 1) for line in unit["Environment"] for word in line.split())
    os.environ["HOME"] = unit["WorkingDirectory"][0]
    applied = ["StateDirectory", "CacheDirectory", "Environment", "ProtectSystem", "ProtectHome"]
    applied += ["PrivateTmp", "DevicePolicy", "DeviceAllow"]
    left = list(_BY_SYSTEMD_ONLY)
    (applied if limit_memory(unit) else left).append("MemoryMax")
    narrow_files(unit, options.write)
    narrow_devices(unit)
    os.chdir(unit["WorkingDirectory"][0])
    os.umask(int(unit["UMask"][0], 8))
    applied += ["UMask", "CapabilityBoundingSet", "NoNewPrivileges", "SystemCallFilter"]
    applied += [
        "RestrictAddressFamilies",
        "RestrictNamespaces",
        "RestrictRealtime",
        "LockPersonality",
    ]
    print("as_service.py: applied", *applied, file=sys.stderr)
    print("as_service.py: not applied", *left, file=sys.stderr, flush=True)
    libc = ctypes.CDLL(None, use_errno=True)
    for capability in range(64):
        libc.prctl(24, capability, 0, 0, 0)  # PR_CAPBSET_DROP
    os.setgroups(groups)
    os.setresgid(gid, gid, gid)
    os.setresuid(uid, uid, uid)
    libc.prctl(38, 1, 0, 0, 0)  # PR_SET_NO_NEW_PRIVS
    narrow_calls(unit)
    os.execvp(options.command[0], options.command)


if __name__ == "__main__":
    main()
