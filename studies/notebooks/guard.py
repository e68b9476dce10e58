"""Lets one user into the app: a layer before the web server's application that answers nobody else; `launch` uses it.

A page of another site that the same browser shows, or another process of the same machine, reaches every local server.
Neither knows the token. The origin tells the pages of other sites, and the name that is asked for those that have
their own name point here.
"""

from __future__ import annotations

import secrets
from collections.abc import Awaitable, Callable, MutableMapping
from typing import Any

TOKEN = "token"  # in the query of the address that opens the app
MANIFEST = "/manifest.json"  # what browsers ask for without their cookies; it has nothing but a name
OWN = (None, "same-origin", "none")  # where a browser says that a request comes from: this app, or its user

Scope = MutableMapping[str, Any]
Receive = Callable[[], Awaitable[MutableMapping[str, Any]]]
Send = Callable[[MutableMapping[str, Any]], Awaitable[None]]


class Guard:
    """An ASGI application that passes on what the user's own browser asks for.

    Args:
        app: what is guarded.
        port: where it is served, on the loopback interface.
        token: admits with the query ``token``, and from then on with a cookie.
        meta: what the app finds in the ``meta`` of its requests.
        entered: called when somebody brings the token.
    """

    def __init__(
        self,
        app: Any,
        port: int,
        token: str,
        meta: dict[str, Any],
        entered: Callable[[], object] = lambda: None,
    ):
        self.app, self.token, self.meta, self.entered = app, token, meta, entered
        self.hosts = [f"{name}:{port}" for name in ("127.0.0.1", "localhost")]
        self.origins = [f"http://{host}" for host in self.hosts]
        self.cookie = f"jaxmpc-explore-{port}"  # a browser keeps one set of cookies for all ports

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Answer, or have it answered."""
        from starlette.requests import HTTPConnection
        from starlette.responses import JSONResponse, PlainTextResponse

        if scope["type"] == "lifespan":
            await self.app(scope, receive, send)
            return
        asked = HTTPConnection(scope)
        refusal = self._foreign(asked)
        if not refusal and (scope["type"], scope["path"]) == ("http", MANIFEST):
            await JSONResponse({"name": "jaxmpc explore"})(scope, receive, send)
            return
        refusal = refusal or self._without_token(asked)
        if not refusal:
            if TOKEN in asked.query_params:
                self.entered()
                send = self._with_cookie(send)
            await self.app({**scope, "meta": self.meta}, receive, send)
        elif scope["type"] == "websocket":
            await send({"type": "websocket.close", "code": 1008, "reason": refusal})
        else:
            await PlainTextResponse(f"{refusal}\n", status_code=403)(scope, receive, send)

    def _foreign(self, asked: Any) -> str:
        """Why a request comes from elsewhere; empty if it does not."""
        hosts, origins = asked.headers.getlist("host"), asked.headers.getlist("origin")
        if len(hosts) != 1 or hosts[0] not in self.hosts:
            return f"This app answers as {' or '.join(self.hosts)} only."
        if any(origin not in self.origins for origin in origins):
            return "This app answers no pages of other sites."
        return ""

    def _without_token(self, asked: Any) -> str:
        """Why a request is not the user's; empty if it is."""
        if TOKEN in asked.query_params:
            known = self._is_token(asked.query_params[TOKEN])
        else:
            known = asked.headers.get("sec-fetch-site") in OWN and self._is_token(
                asked.cookies.get(self.cookie)
            )
        return "" if known else "This app opens with the address that jaxmpc explore has printed."

    def _is_token(self, given: str | None) -> bool:
        return given is not None and secrets.compare_digest(given.encode(), self.token.encode())

    def _with_cookie(self, send: Send) -> Send:
        value = f"{self.cookie}={self.token}; Path=/; HttpOnly; SameSite=Strict"

        async def sending(message: MutableMapping[str, Any]) -> None:
            if message["type"] == "http.response.start":
                message = {**message, "headers": [*message["headers"], (b"set-cookie", value.encode())]}
            await send(message)

        return sending
