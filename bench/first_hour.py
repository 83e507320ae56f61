#!/usr/bin/env python3
"""The first hour of a newcomer: the commands of the first documents, and the pages they lead to.

    bench/first_hour.py --pictures FOLDER [DOCUMENT …]

Plays the commands in the `console` blocks of README.md, docs/getting-started.md and the tutorials
as they are written, those of each document in a fresh folder that has what a reader brings along:
a rendered drive, a board held to the camera, a board on the floor. The camera on the network is
this script; commands for a camera at this machine, and those of cargo, are named and not run.

Every page, whether a file or served (live, view, the guide of a calibration, a site), is opened in
headless Chromium at three widths and in both colour schemes. A page fails by an error on its
console, a request that was not answered, horizontal scrolling, an image without an alternative
text, or text with a contrast below WCAG 2.1, level AA. Screenshots go to FOLDER.

Exits with 1 if a command or a page failed, and lists what. Needs the standard library of Python,
Chromium and the program.
"""

import argparse
import base64
import fcntl
import http.server
import itertools
import json
import os
import re
import shutil
import signal
import struct
import subprocess
import sys
import tempfile
import threading
import time
import zlib
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
WIDTHS = (390, 1024, 1600)
SCHEMES = ("light", "dark")
NETWORK_CAMERA = "http://192.168.1.20:8080/video"
# How commands begin that are not played, or a word in them, and why.
NOT_PLAYED = (
    ("cargo install", "builds from source"),
    ("cargo test", "is for developers"),
    ("/dev/video0", "needs a camera at this machine"),
)
BOARD = "chessboard:9x6:25mm"

# What is wrong with a page, as a list of sentences.
INSPECTION = r"""
(() => {
  const wrong = [];
  const named = (element) => {
    const text = (element.textContent || "").trim().replace(/\s+/g, " ").slice(0, 40);
    const name = element.id ? "#" + element.id : [...element.classList].map((one) => "." + one).join("");
    return `<${element.tagName.toLowerCase()}${name}>` + (text ? ` "${text}"` : "");
  };
  const root = document.documentElement;
  if (root.scrollWidth > root.clientWidth) {
    const wide = [...document.querySelectorAll("body *")]
      .filter((element) => element.getBoundingClientRect().right > root.clientWidth + 0.5);
    wrong.push(`scrolls horizontally: ${root.scrollWidth} px of ${root.clientWidth}, ` + named(wide.at(-1) || root));
  }
  for (const image of document.querySelectorAll("img, canvas, svg")) {
    const isHidden = image.closest("[aria-hidden=true], [role=presentation]") || !image.getClientRects().length;
    if (isHidden || image.parentElement.closest("svg, button, a, [role=img][aria-label]")) continue;
    const isNamed = image.tagName === "IMG" ? image.hasAttribute("alt")
      : image.hasAttribute("aria-label") || image.hasAttribute("aria-labelledby") || image.querySelector(":scope > title");
    if (!isNamed) wrong.push(`no alternative text: ${named(image)}`);
  }
  const painter = document.createElement("canvas").getContext("2d", {willReadFrequently: true});
  const color = (text) => {
    painter.clearRect(0, 0, 1, 1);
    painter.fillStyle = text;
    painter.fillRect(0, 0, 1, 1);
    const [red, green, blue, alpha] = painter.getImageData(0, 0, 1, 1).data;
    return [red, green, blue, alpha / 255];
  };
  const over = (top, below) => [0, 1, 2].map((at) => top[at] * top[3] + below[at] * (1 - top[3])).concat(1);
  const luminance = (rgb) => {
    const [red, green, blue] = rgb.map((value) => value / 255)
      .map((value) => value <= 0.03928 ? value / 12.92 : ((value + 0.055) / 1.055) ** 2.4);
    return 0.2126 * red + 0.7152 * green + 0.0722 * blue;
  };
  const isShape = (element) => element instanceof SVGGeometryElement && !(element instanceof SVGLineElement);
  const opacity = (element) => {
    let whole = 1;
    for (let one = element; one; one = one.parentElement) whole *= Number(getComputedStyle(one).opacity);
    return whole;
  };
  // The colour behind a point, or null where a picture is there.
  const ground = (x, y, element) => {
    const layers = [];
    const stack = document.elementsFromPoint(x, y);
    const from = stack.indexOf(element);
    if (from < 0) return null;
    for (const [at, one] of stack.slice(from).entries()) {
      const style = getComputedStyle(one);
      if (["IMG", "CANVAS", "VIDEO", "image"].includes(one.tagName)) return null;
      if (style.backgroundImage !== "none") return null;
      const isPainted = isShape(one) && style.fill !== "none" && at > 0;
      if (isPainted && style.fill.startsWith("url")) return null;
      const paint = isPainted ? color(style.fill) : color(style.backgroundColor);
      if (isPainted) paint[3] *= Number(style.fillOpacity);
      paint[3] *= opacity(one);
      layers.push(paint);
      if (paint[3] > 0.999) break;
    }
    const page = matchMedia("(prefers-color-scheme: dark)").matches && getComputedStyle(root).colorScheme.includes("dark")
      ? [18, 18, 18, 1] : [255, 255, 255, 1];
    return layers.reduceRight((below, top) => over(top, below), page);
  };
  const seen = new Set();
  const walker = document.createTreeWalker(document.body, NodeFilter.SHOW_TEXT);
  while (walker.nextNode()) {
    const element = walker.currentNode.parentElement;
    if (!walker.currentNode.data.trim() || seen.has(element)) continue;
    seen.add(element);
    const style = getComputedStyle(element);
    if (style.visibility !== "visible" || element.closest(":disabled, [aria-disabled=true], option, script, style")) continue;
    const range = document.createRange();
    range.selectNodeContents(walker.currentNode);
    const box = [...range.getClientRects()].find((rect) => rect.width > 1 && rect.height > 1);
    if (!box) continue;
    // A halo is the ground of its letters.
    const hasHalo = style.paintOrder.startsWith("stroke") && parseFloat(style.strokeWidth) >= 3;
    const below = hasHalo ? color(style.stroke) : ground(box.x + box.width / 2, box.y + box.height / 2, element);
    if (!below) continue;
    const ink = color(element instanceof SVGElement ? style.fill : style.color);
    ink[3] *= opacity(element);
    const [a, b] = [luminance(over(ink, below)), luminance(below)].map((value) => value + 0.05);
    const ratio = Math.max(a, b) / Math.min(a, b);
    const size = parseFloat(style.fontSize);
    const isLarge = size >= 24 || (size >= 18.66 && Number(style.fontWeight) >= 700);
    if (ratio < (isLarge ? 3 : 4.5)) wrong.push(`contrast of ${ratio.toFixed(2)}: ${named(element)}`);
  }
  return wrong;
})()
"""


class Browser:
    """Headless Chromium, driven by the DevTools protocol over a pair of pipes."""

    def __init__(self, program):
        # Above descriptors 3 and 4, at which Chromium expects its ends.
        ends = [fcntl.fcntl(end, fcntl.F_DUPFD, 10) for end in (*os.pipe(), *os.pipe())]
        reads, self.output, self.input, writes = ends
        options = ["--headless=new", "--no-sandbox", "--disable-gpu", "--remote-debugging-pipe", "--hide-scrollbars"]
        self.profile = tempfile.TemporaryDirectory(ignore_cleanup_errors=True)
        self.process = subprocess.Popen(
            [program, *options, f"--user-data-dir={self.profile.name}", "about:blank"],
            preexec_fn=lambda: (os.dup2(reads, 3), os.dup2(writes, 4)),
            close_fds=False, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL,
        )  # fmt: skip
        os.close(reads)
        os.close(writes)
        self.numbers, self.rest, self.session, self.troubles = itertools.count(1), b"", None, []
        target = self.ask("Target.createTarget", url="about:blank")["targetId"]
        self.session = self.ask("Target.attachToTarget", targetId=target, flatten=True)["sessionId"]
        for domain in ("Page", "Runtime", "Log", "Network"):
            self.ask(f"{domain}.enable")

    def ask(self, method, **parameters):
        number = next(self.numbers)
        message = {"id": number, "method": method, "params": parameters}
        if self.session:
            message["sessionId"] = self.session
        os.write(self.output, json.dumps(message).encode() + b"\0")
        while True:
            reply = self.next()
            if reply.get("id") == number:
                if "error" in reply:
                    raise SystemExit(f"{method}: {reply['error']}")
                return reply["result"]

    def next(self):
        while b"\0" not in self.rest:
            more = os.read(self.input, 1 << 20)
            if not more:
                raise SystemExit("Chromium has ended")
            self.rest += more
        message, self.rest = self.rest.split(b"\0", 1)
        message = json.loads(message)
        self.notice(message.get("method"), message.get("params", {}))
        return message

    def notice(self, event, about):
        if event == "Runtime.exceptionThrown":
            details = about["exceptionDetails"]
            self.troubles.append("exception: " + details.get("exception", details).get("description", details["text"]))
        elif event == "Runtime.consoleAPICalled" and about["type"] in ("error", "assert"):
            self.troubles.append("console: " + " ".join(str(one.get("value")) for one in about["args"]))
        elif event == "Log.entryAdded" and about["entry"]["level"] == "error":
            self.troubles.append(f"{about['entry']['text']} {about['entry'].get('url', '')}")
        elif event == "Network.responseReceived" and about["response"]["status"] >= 400:
            self.troubles.append(f"{about['response']['status']}: {about['response']['url']}")
        elif event == "Network.loadingFailed" and not about.get("canceled"):
            self.troubles.append(f"not loaded: {about['errorText']}")

    def evaluate(self, expression):
        options = {"returnByValue": True, "awaitPromise": True}
        result = self.ask("Runtime.evaluate", expression=expression, **options)
        if "exceptionDetails" in result:
            raise SystemExit(f"the inspection failed: {result['exceptionDetails']}")
        return result["result"].get("value")

    def look(self, url, width, scheme, picture):
        """Opens a page, waits until it has settled, writes a screenshot; returns what is wrong."""
        media = [{"name": "prefers-color-scheme", "value": scheme}]
        self.ask("Emulation.setEmulatedMedia", features=media)
        self.size(width, 900)
        self.troubles = []
        self.ask("Page.navigate", url=url)
        loaded = "document.readyState === 'complete' ? done() : addEventListener('load', done)"
        self.evaluate(f"new Promise((done) => {loaded})")
        # Pages that are served get their data after they have loaded.
        self.evaluate("new Promise((done) => setTimeout(done, 1500))")
        height = self.evaluate("Math.max(900, document.documentElement.scrollHeight)")
        self.size(width, min(height, 12000))
        self.evaluate("new Promise((done) => setTimeout(done, 200))")
        wrong = self.evaluate(INSPECTION)
        shot = self.ask("Page.captureScreenshot", format="png")["data"]
        picture.write_bytes(base64.b64decode(shot))
        wrong += self.troubles
        self.ask("Page.navigate", url="about:blank")
        return list(dict.fromkeys(wrong))

    def wait_until_saved(self, url):
        """Keeps the page of a run open, so that it stays, until its results are written."""
        self.ask("Page.navigate", url=url)
        phase = "fetch('/state').then((reply) => reply.json()).then((state) => state.status.phase)"
        until = time.monotonic() + 120
        while time.monotonic() < until:
            time.sleep(0.5)
            if self.evaluate(phase) == "saved":
                return True
        return False

    def size(self, width, height):
        self.ask("Emulation.setDeviceMetricsOverride", width=width, height=height, deviceScaleFactor=1, mobile=False)

    def close(self):
        self.process.terminate()
        self.process.wait()
        self.profile.cleanup()


class NetworkCamera(http.server.ThreadingHTTPServer):
    """A camera on the network: the pictures of a Motion JPEG recording, again and again."""

    daemon_threads = True

    def __init__(self, recording, rate):
        pictures = jpegs(recording)

        class Handler(http.server.BaseHTTPRequestHandler):
            def log_message(self, *_):
                pass

            def do_GET(self):
                self.send_response(200)
                self.send_header("Content-Type", "multipart/x-mixed-replace; boundary=frame")
                self.end_headers()
                try:
                    for picture in itertools.cycle(pictures):
                        self.wfile.write(b"--frame\r\nContent-Type: image/jpeg\r\n")
                        self.wfile.write(b"Content-Length: %d\r\n\r\n%s\r\n" % (len(picture), picture))
                        time.sleep(1 / rate)
                except OSError:
                    pass

        super().__init__(("127.0.0.1", 0), Handler)
        self.url = f"http://127.0.0.1:{self.server_port}/video"
        threading.Thread(target=self.serve_forever, daemon=True).start()


def jpegs(recording):
    """The pictures of a Motion JPEG recording in AVI."""
    data, at, pictures = recording.read_bytes(), 0, []
    while (at := data.find(b"00dc", at)) >= 0:
        (size,) = struct.unpack_from("<I", data, at + 4)
        picture = data[at + 8 : at + 8 + size]
        if picture.startswith(b"\xff\xd8"):
            pictures.append(picture)
        at += 8
    return pictures


def write_floor(path):
    """Writes the picture of a white floor of 2 m, 1 mm per pixel, with the board about its corners.

    Repeated over the floor, it has a board about the place where a rendered drive begins.
    """
    side, square, across, down = 2000, 25, 10, 7
    rows = []
    for y in range(side):
        row = bytearray(b"\xe0" * side)
        line = ((y + side // 2) % side - side // 2 + down * square // 2) // square
        if 0 <= line < down:
            for column in range(line % 2, across, 2):
                start = column * square - across * square // 2
                for x in range(start, start + square):
                    row[x % side] = 0x20
        rows.append(b"\0" + bytes(row))
    chunks = (
        (b"IHDR", struct.pack(">IIBBBBB", side, side, 8, 0, 0, 0, 0)),
        (b"IDAT", zlib.compress(b"".join(rows))),
        (b"IEND", b""),
    )
    png = b"\x89PNG\r\n\x1a\n"
    for kind, data in chunks:
        png += struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))
    path.write_bytes(png)


def render(program, folder):
    """Renders a drive, a board held to its camera, and that board on the floor, into folders."""
    write_floor(folder / "floor.png")
    mounted = "--camera board/camera.yaml --height 0.75 --pitch 3 --fps 15 --format mjpeg"
    for options in (
        f"--board {BOARD} --size 320x240 -o board",
        f"{mounted} --path eight --length 2.5 --speed 0.7 -o drive",
        f"{mounted} --path still --duration 0.3 --texture floor.png --photo-width 2 --tiling repeat -o floor",
    ):
        subprocess.run([program, "simulate", *options.split(), "--quiet"], cwd=folder, check=True)


def bring(rendered, folder):
    """Writes what a reader has: recordings, photographs, and a camera file."""
    for name in ("drive.mp4", "monday.mp4", "tuesday.mp4", "yard.mp4"):
        shutil.copy(rendered / "drive/sim.avi", folder / name)
    shutil.copy(rendered / "board/board.avi", folder / "board.mp4")
    # The README shows how to run before it shows how to calibrate.
    for name in ("camera.yaml", "phone.yaml"):
        shutil.copy(rendered / "board/camera.yaml", folder / name)
    shutil.copy(rendered / "drive/truth.tum", folder / "truth.tum")
    (folder / "photo.jpg").write_bytes(jpegs(rendered / "drive/sim.avi")[3])
    (folder / "floor.jpg").write_bytes(jpegs(rendered / "floor/sim.avi")[0])


def commands_in(text):
    """The commands of the `console` blocks of a document."""
    blocks = re.findall(r"^```console\n(.*?)^```", text, re.M | re.S)
    joined = (block.replace("\\\n", " ") for block in blocks)
    return [line[2:].split(" #")[0].strip() for block in joined for line in block.splitlines() if line.startswith("$ ")]


class Hour:
    """One newcomer: the program, the browser, and what has gone wrong so far."""

    def __init__(self, program, browser, pictures):
        self.program, self.browser, self.pictures = program, browser, pictures
        self.failures, self.pages = [], 0

    def fail(self, place, what):
        self.failures.append(f"{place}: {what}")
        print(f"  FAILED: {what}", flush=True)

    def look(self, url, name, place):
        """Looks at a page at every width and in every colour scheme."""
        self.pages += 1
        found = {}
        for width, scheme in itertools.product(WIDTHS, SCHEMES):
            picture = self.pictures / f"{name}-{width}-{scheme}.png"
            for what in self.browser.look(url, width, scheme, picture):
                found.setdefault(what, []).append(f"{width} {scheme}")
        for what, views in found.items():
            self.fail(f"{place}, page {name}", f"{what} ({', '.join(views)})")

    def play(self, document, commands, rendered, camera):
        """Plays the commands of a document in a fresh folder, and looks at the pages they write."""
        with tempfile.TemporaryDirectory() as place:
            folder = Path(place)
            bring(rendered, folder)
            (folder / ".bin").mkdir()
            (folder / ".bin/odograph").symlink_to(self.program)
            environment = {
                **os.environ,
                "PATH": f"{folder}/.bin:{os.environ['PATH']}",
                "XDG_CONFIG_HOME": f"{folder}/.config",
            }
            seen = set(folder.rglob("*.html"))
            for number, command in enumerate(commands, 1):
                self.play_one(command, f"{document.stem}-{number:02}", folder, environment, camera)
                for page in sorted(set(folder.rglob("*.html")) - seen):
                    seen.add(page)
                    name = f"{document.stem}-{number:02}-{page.parent.name}-{page.stem}"
                    self.look(page.as_uri(), name, f"{document.name}: {command}")

    def play_one(self, command, name, folder, environment, camera):
        reason = next((why for part, why in NOT_PLAYED if part in command), None)
        print(f"{name}: {command}" + (f"  (not played: {reason})" if reason else ""), flush=True)
        if reason:
            return
        played = command.replace("cargo run --release -- ", "odograph ").replace(NETWORK_CAMERA, camera.url)
        is_site = played.startswith("odograph site serve")
        is_server = is_site or "--serve" in played or played.startswith("odograph view")
        if is_server:
            played = played.replace("--serve", "") + f" {'--listen' if is_site else '--serve'} 127.0.0.1:0"
        # The camera file that a reader of the README has is written again by it.
        for written in re.findall(r"-o (\S+\.(?:yaml|toml))", played):
            (folder / written).unlink(missing_ok=True)
        begun = time.monotonic()
        process = subprocess.Popen(
            ["sh", "-c", f"exec {played}"], cwd=folder, env=environment,
            stdin=subprocess.DEVNULL, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True,
        )  # fmt: skip
        if is_server:
            code, told = self.visit(process, name, command)
        else:
            told = process.communicate()[1]
            code = process.returncode
        print(f"  {time.monotonic() - begun:.1f} s", flush=True)
        if code != 0:
            self.fail(f"{name}: {command}", f"ended with {code}: {told.strip()[-400:]}")

    def visit(self, process, name, command):
        """Looks at the page of a command while it runs and, of a recording, when it is saved."""
        lines = []
        address = None
        for line in process.stderr:
            lines.append(line)
            if address := re.search(r"http://\S+?(?=[ ;,\n])", line):
                break
        threading.Thread(target=lambda: lines.extend(process.stderr), daemon=True).start()
        if address:
            url = address[0]
            self.look(url, f"{name}-served", command)
            if "--realtime" in command:
                if self.browser.wait_until_saved(url):
                    self.look(url, f"{name}-saved", command)
                else:
                    self.fail(command, "was not saved in time")
        else:
            self.fail(command, "named no address of a page")
        if process.poll() is None:
            process.send_signal(signal.SIGINT)
        code = process.wait()
        # A live run that was interrupted says so.
        return (0 if code == 130 else code), "".join(lines)


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("documents", nargs="*", type=Path, help="[default: README.md, getting-started.md, the tutorials]")
    parser.add_argument("--pictures", type=Path, required=True, help="folder for the screenshots")
    parser.add_argument("--program", type=Path, default=ROOT / "target/release/odograph")
    arguments = parser.parse_args()
    browser = next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), None)
    if not browser:
        raise SystemExit("there is no Chromium on this machine")
    program = arguments.program.resolve(strict=True)
    tutorials = sorted((ROOT / "docs/tutorials").glob("*.md"))
    documents = arguments.documents or [ROOT / "README.md", ROOT / "docs/getting-started.md", *tutorials]
    arguments.pictures.mkdir(parents=True, exist_ok=True)
    hour = Hour(program, Browser(browser), arguments.pictures)
    with tempfile.TemporaryDirectory() as scratch:
        rendered = Path(scratch)
        render(program, rendered)
        camera = NetworkCamera(rendered / "drive/sim.avi", 15)
        for document in documents:
            hour.play(document, commands_in(document.read_text()), rendered, camera)
        calibrating = NetworkCamera(rendered / "board/board.avi", 30)
        # Pages that these documents do not lead to.
        others = (
            f"odograph calibrate --live {calibrating.url} --serve --board {BOARD} -o guided.yaml",
            "odograph run drive.mp4 yard.mp4 --camera camera.yaml --height 0.75 -o both/",
            "odograph view both/drive/map.gpkg",
            "odograph localize photo.jpg --map both/drive/map.gpkg -o where/",
            "odograph site serve hall/",
        )
        hour.play(Path("others"), others, rendered, camera)
    hour.browser.close()
    print(f"{hour.pages} pages; {len(hour.failures)} failures", *hour.failures, sep="\n")
    return 1 if hour.failures else 0


if __name__ == "__main__":
    sys.exit(main())
