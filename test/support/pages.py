# SPDX-License-Identifier: Apache-2.0
"""Content of a page, rendered by a browser if installed, else parsed from its tags."""

from __future__ import annotations

from base64 import b64decode
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial
from html.parser import HTMLParser
from http.server import SimpleHTTPRequestHandler, ThreadingHTTPServer
import json
from pathlib import Path
import re
import shutil
import subprocess
import tempfile
from threading import Thread

from tools.browser import BROWSER, HEADLESS

#: Loads the page in a frame with the width of a telephone, and extracts its content. The page
#: itself has no script.
_WRAPPER = """<!DOCTYPE html><meta charset="utf-8"><body>
<iframe src="PAGE" style="width: 375px; height: 800px; border: 0"></iframe><script>
document.querySelector('iframe').onload = (event) => {
  const view = event.target.contentWindow, page = view.document;
  const seen = {
    text: page.body.innerText,
    images: [...page.images].map((image) => [image.alt, image.naturalWidth]),
    requests: view.performance.getEntriesByType('resource').map((entry) => entry.name),
    overflow: page.documentElement.scrollWidth - page.documentElement.clientWidth,
  };
  const text = document.createElement('pre');
  text.textContent = JSON.stringify(seen);
  document.body.replaceChildren(text);
};
</script></body>"""


@dataclass(frozen=True)
class Seen:
    """Content of a page: text, images with widths, and external requests."""

    text: str
    images: list[tuple[str, int]]
    requests: list[str]
    #: Excess of the page width over a telephone [pixels].
    overflow: int


def look_at(page: Path) -> Seen:
    """Load a page in a browser, or parse it without a browser."""
    return _in_browser(page, BROWSER) if BROWSER else _by_tags(page)


class _Handler(SimpleHTTPRequestHandler):
    def log_message(self, *_words: object) -> None:
        pass


@contextmanager
def _served(folder: Path) -> Iterator[str]:
    server = ThreadingHTTPServer(('127.0.0.1', 0), partial(_Handler, directory=str(folder)))
    thread = Thread(target=server.serve_forever)
    thread.start()
    try:
        yield f'http://127.0.0.1:{server.server_port}'
    finally:
        server.shutdown()
        thread.join()
        server.server_close()


def _in_browser(page: Path, browser: str) -> Seen:
    with tempfile.TemporaryDirectory() as scratch:
        folder = Path(scratch, 'served')
        folder.mkdir()
        shutil.copy(page, folder / 'page.html')
        (folder / 'wrapper.html').write_text(_WRAPPER.replace('PAGE', 'page.html'))
        with _served(folder) as address:
            ended = subprocess.run(
                [
                    browser,
                    *HEADLESS,
                    f'--user-data-dir={scratch}/profile',
                    '--dump-dom',
                    f'{address}/wrapper.html',
                ],
                capture_output=True,
                text=True,
                # Timeout of a hanging browser.
                timeout=300,
                check=True,
            )
    found = re.search(r'<pre>(.*)</pre>', ended.stdout, re.DOTALL)
    assert found, ended.stdout + ended.stderr
    texts: list[str] = []
    reader = HTMLParser()
    setattr(reader, 'handle_data', texts.append)  # noqa: B010
    reader.feed(found[1])
    seen = json.loads(''.join(texts))
    outside = [name for name in seen['requests'] if not name.startswith('data:')]
    return Seen(
        text=seen['text'],
        images=[(alt, width) for alt, width in seen['images']],
        requests=outside,
        overflow=seen['overflow'],
    )


class _Tags(HTMLParser):
    """Collects the text, images and external requests of a page."""

    def __init__(self) -> None:
        super().__init__()
        self.texts: list[str] = []
        self.images: list[tuple[str, int]] = []
        self.requests: list[str] = []
        self._hidden = 0

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self._hidden += tag in ('style', 'script', 'title')
        given = dict(attrs)
        for name in ('src', 'href', 'data', 'srcset'):
            value = given.get(name) or ''
            if value.startswith('data:image/png;base64,'):
                image = b64decode(value.partition(',')[2])
                self.images.append((given.get('alt') or '', int.from_bytes(image[16:20], 'big')))
            elif value and not value.startswith('#'):
                # A link within the page is not a request.
                self.requests.append(value)

    def handle_endtag(self, tag: str) -> None:
        self._hidden -= tag in ('style', 'script', 'title')

    def handle_data(self, data: str) -> None:
        if self._hidden:
            self.requests += re.findall(r'url\([^)]*\)|@import[^;]*', data)
        else:
            self.texts.append(data)


def _by_tags(page: Path) -> Seen:
    tags = _Tags()
    tags.feed(page.read_text(encoding='utf-8'))
    return Seen(''.join(tags.texts), tags.images, tags.requests, 0)
