"""The report of a run as one self-contained HTML page."""

from .document import palette_css as palette_css
from .page import PAGE as PAGE
from .page import write_page as write_page
