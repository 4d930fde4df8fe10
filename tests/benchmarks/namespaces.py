"""A small network on one machine: network namespaces, each with its own address, on one bridge.

Programs in a namespace run as if on a separate machine. This module needs root and the command `ip`; the context
manager `network` removes all namespaces on exit.
"""

import os
import shutil
import signal
import subprocess
import uuid
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager
from pathlib import Path

SUBNET = "10.77.31"


def unsupported_reason() -> str | None:
    """Return why this machine cannot make network namespaces, or None if it can."""
    if shutil.which("ip") is None:
        return "command `ip` (package iproute2) is not installed"
    done = subprocess.run(["unshare", "--net", "true"], capture_output=True, text=True, check=False)
    return " ".join(done.stderr.split()) or "not allowed" if done.returncode else None


class Node:
    """A machine of the network: a network namespace with an address."""

    def __init__(self, namespace: str, address: str) -> None:
        self.namespace, self.address = namespace, address

    def popen(self, words: Sequence[str], log: Path, folder: Path) -> subprocess.Popen[bytes]:
        """Start a program on this node, in its own process group."""
        with log.open("ab") as output:
            command = ["ip", "netns", "exec", self.namespace, *words]
            return subprocess.Popen(command, stdout=output, stderr=output, cwd=folder, start_new_session=True)

    def received_bytes(self) -> int:
        """Return the number of bytes that this node has received."""
        file = "/sys/class/net/eth0/statistics/rx_bytes"
        return int(subprocess.check_output(["ip", "netns", "exec", self.namespace, "cat", file]))


@contextmanager
def network(names: Sequence[str]) -> Iterator[dict[str, Node]]:
    """Create a network namespace per name, connected by a bridge and to nothing else; yield the nodes by name."""
    tag = f"reskin-{uuid.uuid4().hex[:6]}"
    with ExitStack() as down:

        def ip(*words: str) -> None:
            subprocess.run(["ip", *words], check=True, capture_output=True)

        def add(namespace: str) -> None:
            ip("netns", "add", namespace)
            down.callback(ip, "netns", "del", namespace)

        hub = f"{tag}-hub"
        add(hub)
        ip("-n", hub, "link", "add", "br0", "type", "bridge")
        ip("-n", hub, "link", "set", "br0", "up")
        nodes = {}
        for i, name in enumerate(names, 1):
            node = Node(f"{tag}-{name}", f"{SUBNET}.{i}")
            add(node.namespace)
            ip("-n", hub, "link", "add", f"v{i}", "type", "veth", "peer", "name", "eth0", "netns", node.namespace)
            ip("-n", hub, "link", "set", f"v{i}", "master", "br0", "up")
            ip("-n", node.namespace, "addr", "add", f"{node.address}/24", "dev", "eth0")
            for device in ("eth0", "lo"):
                ip("-n", node.namespace, "link", "set", device, "up")
            nodes[name] = node
        yield nodes


def kill(process: subprocess.Popen[bytes], word: signal.Signals = signal.SIGKILL) -> None:
    """Kill a program and its child processes, as if its machine were switched off."""
    try:
        os.killpg(process.pid, word)
    except ProcessLookupError:
        pass
    process.wait()
