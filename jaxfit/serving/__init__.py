"""A page on this machine that fits pictures and webcams: its server, what the server does with a picture, the page."""

from jaxfit.serving.server import Server
from jaxfit.serving.service import Service

__all__ = ["Server", "Service"]
