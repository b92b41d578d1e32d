"""`docker/nginx.conf` before a real API: TLS, names and forms go through."""

from __future__ import annotations

import os
import re
import shutil
import ssl
import subprocess
import sys
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path
from typing import NamedTuple

import httpx
import pytest

from graspd.api.access.keys import KeyFile, Scope
from tests.conftest import REPOSITORY
from tests.servers import free_ports
from tests.waiting import until

NAME = "grasps.example.org"


def served(folder: Path, api: int, plain: int, secure: int) -> Path:
    """The configuration on loopback ports, with a certificate for one day, as a whole nginx.conf."""
    make = f"openssl req -x509 -newkey rsa:2048 -nodes -days 1 -subj /CN={NAME} -addext subjectAltName=DNS:{NAME}"
    files = ["-keyout", str(folder / "key.pem"), "-out", str(folder / "cert.pem")]
    subprocess.run([*make.split(), *files], check=True, capture_output=True)
    text = (REPOSITORY / "docker" / "nginx.conf").read_text()
    for old, new in {
        "listen 80;": f"listen 127.0.0.1:{plain};",
        "listen 443 ssl;": f"listen 127.0.0.1:{secure} ssl;",
        f"/etc/ssl/certs/{NAME}.pem": str(folder / "cert.pem"),
        f"/etc/ssl/private/{NAME}.key": str(folder / "key.pem"),
        "127.0.0.1:8000": f"127.0.0.1:{api}",
    }.items():
        assert old in text
        text = text.replace(old, new)
    kinds = ("client_body", "proxy", "fastcgi", "uwsgi", "scgi")
    temporary = "".join(f"{kind}_temp_path {folder}/{kind};\n" for kind in kinds)
    path = folder / "nginx.conf"
    path.write_text(
        f"user root;\npid {folder}/pid;\nerror_log {folder}/error.log;\nevents {{}}\n"
        f"http {{ access_log off;\n{temporary}{text} }}\n"
    )
    return path


class Proxy(NamedTuple):
    """A client that believes the proxy's certificate, a key of the API behind it, the name and port it goes by."""

    client: httpx.Client
    key: str
    host: str
    plain_port: int


@pytest.fixture(scope="module")
def proxy(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Proxy]:
    program = shutil.which("nginx") or shutil.which("nginx", path="/usr/sbin")
    if program is None or shutil.which("openssl") is None:
        pytest.skip("nginx or openssl is not installed: `apt-get install nginx-light openssl`")
    folder = tmp_path_factory.mktemp("proxy")
    api, plain, secure = free_ports(3)
    key = KeyFile(folder / "data" / "keys.json").add("admin", Scope.ADMIN)
    environment = os.environ | {"GRASPD_DATA_DIR": str(folder / "data"), "GRASPD_PORT": str(api)}
    environment |= {"FORWARDED_ALLOW_IPS": "127.0.0.1"}
    configuration = served(folder, api, plain, secure)
    with (folder / "api.log").open("wb") as log:
        started = [
            subprocess.Popen([sys.executable, "-m", "graspd", "api"], env=environment, cwd=REPOSITORY, stderr=log),
            subprocess.Popen([program, "-c", str(configuration), "-g", "daemon off;"], stderr=log),
        ]
    trust = ssl.create_default_context(cafile=str(folder / "cert.pem"))
    # The certificate is for the name, the address is loopback's.
    client = httpx.Client(
        base_url=f"https://127.0.0.1:{secure}",
        headers={"Host": f"{NAME}:{secure}"},
        verify=trust,
        trust_env=False,
        timeout=60,
        event_hooks={"request": [lambda request: request.extensions.update(sni_hostname=NAME)]},
    )

    def answers() -> bool:
        with suppress(httpx.HTTPError):
            return client.get("/healthz").status_code == 200
        return False

    try:
        until(answers, "the API answers through the proxy", logs=(folder / "api.log").read_text)
        yield Proxy(client, key, f"{NAME}:{secure}", plain)
    finally:
        client.close()
        for process in started:
            process.terminate()
        for process in started:
            process.wait(timeout=60)


def test_a_key_opens_the_api_through_tls(proxy: Proxy) -> None:
    assert proxy.client.get("/v1/jobs").status_code == 401
    answer = proxy.client.get("/v1/jobs", headers={"Authorization": f"Bearer {proxy.key}"})
    assert answer.status_code == 200, answer.text
    assert "max-age" in answer.headers["strict-transport-security"]


def test_a_browser_signs_in_through_the_proxy(proxy: Proxy) -> None:
    assert proxy.client.get("/login").status_code == 200
    own = {"Origin": f"https://{proxy.host}", "Sec-Fetch-Site": "same-origin"}
    answer = proxy.client.post("/login", data={"key": proxy.key}, headers=own)
    assert answer.status_code == 303, answer.text
    assert re.search("HttpOnly", answer.headers["set-cookie"], re.IGNORECASE)
    answer = proxy.client.post("/login", data={"key": proxy.key}, headers={"Origin": "https://elsewhere.example"})
    assert answer.status_code == 403


def test_plain_http_is_sent_to_tls(proxy: Proxy) -> None:
    plain = f"http://127.0.0.1:{proxy.plain_port}/jobs"
    answer = httpx.get(plain, headers={"Host": NAME}, trust_env=False, timeout=60)
    assert answer.status_code == 301 and answer.headers["location"] == f"https://{NAME}/jobs"
