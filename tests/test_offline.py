"""Nothing that is run asks the network: this process and the commands that tests start are denied it."""

import os
import socket
import subprocess
import sys
from pathlib import Path
from urllib.request import urlopen

import calling
import pytest
import test_tune_command

ASKED = [
    lambda: socket.create_connection(("192.0.2.1", 80), timeout=1),  # an address for documentation, of nobody
    lambda: socket.getaddrinfo("example.org", 443),
    lambda: socket.gethostbyname("example.org"),
    lambda: socket.socket(socket.AF_INET, socket.SOCK_DGRAM).sendto(b"x", ("192.0.2.1", 53)),
    lambda: urlopen("http://192.0.2.1/"),
]


@pytest.mark.parametrize("ask", ASKED)
def test_the_network_is_denied(ask, recwarn):
    with pytest.raises(RuntimeError, match="the network was asked"):
        ask()


def test_this_machine_may_be_asked():
    with socket.create_server(("127.0.0.1", 0)) as server:
        socket.create_connection(server.getsockname()).close()


@pytest.mark.parametrize("module", [calling, test_tune_command])
def test_commands_that_tests_start_are_denied_it(module):
    code = "import socket; socket.create_connection(('192.0.2.1', 80), timeout=1)"
    environment = os.environ | {"PYTHONPATH": module.SEARCHED}
    done = subprocess.run([sys.executable, "-c", code], env=environment, capture_output=True, text=True)
    assert "RuntimeError: the network was asked for 192.0.2.1" in done.stderr
    assert Path(module.SEARCHED.split(os.pathsep)[0]) == Path(__file__).parents[1]
