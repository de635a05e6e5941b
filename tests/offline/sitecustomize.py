"""No network: a process that starts with this folder on its PYTHONPATH can reach no other machine, only itself.

Python runs a module of this name when it starts. What is denied fails the test, however deep the library that asked.
"""

import sys

OWN = ("localhost", "127.0.0.1", "::1", "0.0.0.0", "", None)


def deny(event: str, arguments: tuple) -> None:
    """Names are looked up and connections made on this machine alone; sockets of the Unix kind have no host."""
    if event in ("socket.connect", "socket.sendto", "socket.sendmsg"):
        address = arguments[1]
        host = address[0] if isinstance(address, tuple) else None
    elif event in ("socket.getaddrinfo", "socket.gethostbyname", "socket.gethostbyaddr"):
        host = arguments[0]
    elif event == "urllib.Request":
        raise RuntimeError(f"the network was asked for {arguments[0]}")
    else:
        return
    if (host.decode() if isinstance(host, bytes) else host) not in OWN:
        raise RuntimeError(f"the network was asked for {host}")


sys.addaudithook(deny)
