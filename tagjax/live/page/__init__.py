"""A web page that shows a running stream."""

from .server import LivePage as LivePage
from .server import PageSettings as PageSettings
