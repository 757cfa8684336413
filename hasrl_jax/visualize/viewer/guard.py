"""Who may open the viewer's page and move its sliders.

A page of any site that the same browser shows can send requests to this machine. Those carry the name of that site: as
`Origin`, or, where its name was made to lead here (DNS rebinding), as `Host`. Neither gets an answer. Where the viewer
listens beyond this machine, a token in its address, then in a cookie, is asked for as well.
"""

import hmac
import http
import inspect
import ipaddress
import re
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any
from urllib.parse import parse_qs, urlsplit

from hasrl_jax.errors import ConfigError

LOOPBACK_NAMES = ("127.0.0.1", "localhost", "[::1]")
COOKIE = "hasrl_viewer"
PARAMETER = "token"


def is_loopback(host: str) -> bool:
    """Whether only this machine can reach what listens on `host`."""
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return host == "localhost"


def refusal(headers: Any, path: str, token: str | None) -> str | None:
    """Why a request gets no answer; None where it gets one.

    Args:
      headers: of the request, with `get_all(name)`.
      path: with its query.
      token: what must be shown; None where only this machine can ask, which then must be asked for by its own names.
    """
    hosts, origins = headers.get_all("Host"), headers.get_all("Origin")
    if len(hosts) != 1:
        return "one Host is needed"
    host = hosts[0].lower()
    if token is None and re.sub(r":\d+$", "", host) not in LOOPBACK_NAMES:
        return "the viewer answers to localhost only"
    if any(origin.lower() != f"http://{host}" for origin in origins):
        return "the viewer answers to its own page only"
    if token is not None and not any(_same(shown, token) for shown in _shown(headers, path)):
        return "the address that the viewer printed has a token"
    return None


def _shown(headers: Any, path: str) -> Iterator[str]:
    """The tokens of a request: in its address, and in its cookies."""
    yield from parse_qs(urlsplit(path).query).get(PARAMETER, [])
    for header in headers.get_all("Cookie"):
        for cookie in header.split(";"):
            name, _, value = cookie.strip().partition("=")
            if name == COOKIE:
                yield value


def _same(shown: str, token: str) -> bool:
    return hmac.compare_digest(shown.encode(), token.encode())


@contextmanager
def guarded(token: str | None) -> Iterator[None]:
    """Servers that websockets starts meanwhile answer to those alone whom `refusal` lets in.

    Raises:
      ConfigError: none was started, so nothing would be guarded.
    """
    from websockets.asyncio import server

    serve, started = server.serve, []

    def serve_guarded(*args: Any, process_request: Callable[..., Any] | None = None, **kwargs: Any) -> Any:
        started.append(True)

        async def answer(connection: Any, request: Any) -> Any:
            reason = refusal(request.headers, request.path, token)
            if reason:
                return connection.respond(http.HTTPStatus.FORBIDDEN, f"{reason}\n")
            response = process_request(connection, request) if process_request else None
            if inspect.isawaitable(response):
                response = await response
            if response is not None:
                response.headers["X-Frame-Options"] = "DENY"  # no page of another site around this one
                if token is not None:
                    response.headers["Set-Cookie"] = f"{COOKIE}={token}; HttpOnly; SameSite=Strict; Path=/"
            return response

        return serve(*args, process_request=answer, **kwargs)

    server.serve = serve_guarded  # type: ignore[assignment, misc]
    try:
        yield
    finally:
        server.serve = serve  # type: ignore[misc]
    if not started:
        raise ConfigError("the installed viser starts its server in another way; install the version of the lock file")
