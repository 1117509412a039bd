"""A separate network for tests that communicate over one: a Linux namespace with only the loopback.

Run as a program, it brings the loopback up and executes the command in its arguments.
"""

import fcntl
import os
import socket
import struct
import sys
from collections.abc import Sequence

SET_FLAGS, UP_AND_RUNNING = 0x8914, 0x1 | 0x40  # linux/sockios.h, linux/if.h


def has_only_loopback() -> bool:
    """This process sees no network but the loopback."""
    return [name for _, name in socket.if_nameindex()] == ["lo"]


def in_namespace(command: Sequence[str]) -> list[str]:
    """A command line that runs a command in a namespace with only loopback, as root or not."""
    user = [] if os.geteuid() == 0 else ["--user", "--map-root-user"]
    return ["unshare", "--net", *user, sys.executable, __file__, *command]


if __name__ == "__main__":
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as any_socket:
        fcntl.ioctl(any_socket, SET_FLAGS, struct.pack("16sh14x", b"lo", UP_AND_RUNNING))
    os.execvp(sys.argv[1], sys.argv[1:])
