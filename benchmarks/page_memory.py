"""Whether memory stays flat while somebody switches layers, floors, views and positions for a long time.

A page in Chromium before `isodyn serve` on a floor of 120 x 110 m. Every round shows each layer once, three marks, both
views and a deep zoom; then memory is read: of the server, and of the page (its JavaScript heap, garbage collected;
textures and geometries that three.js holds cannot be asked, so the browser's whole memory is told, too). An hour of
somebody who switches every three seconds is 1,200 switches. The last third of the rounds is set against the third after
warming up: a ratio of 1 is flat.

    python benchmarks/page_memory.py [--switches 1200]
"""

import argparse
import sys
import time
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
from first_picture import CHROMIUM, KEY, Server, fill
from playwright.sync_api import Page, sync_playwright

CLAIMED = 1.1


def rss_mb(pid: int) -> float:
    """Resident memory of a process and all it started."""
    total, wanted = 0.0, [pid]
    while wanted:
        each = wanted.pop()
        try:
            status = Path(f"/proc/{each}/status").read_text()
            total += next(float(line.split()[1]) for line in status.splitlines() if line.startswith("VmRSS")) / 1024
            for task in Path(f"/proc/{each}/task").iterdir():
                wanted += [int(child) for child in (task / "children").read_text().split()]
        except (OSError, StopIteration):
            continue
    return total


def a_round(page: Page, floor: str) -> int:
    """Every layer, some marks and the views; how many switches that was."""
    path = page.locator("#canvas").get_attribute("src")
    layers = page.locator("#layer option").evaluate_all("(all) => all.map((o) => o.value)")

    def ask(what: str, asked: dict) -> None:
        script = """([path, what, asked]) => fetch(`${path}/${what}`, {method: "POST", body: JSON.stringify(asked)})
            .then((answer) => { if (!answer.ok) throw new Error(answer.status); })"""
        page.evaluate(script, [path, what, asked])
        page.wait_for_timeout(150)

    poses = [{"position_m": [60.0, 50.0, z], "look_at_m": [60.0, 55.0, 1.0]} for z in (15.0, 60.0)]
    for k, layer in enumerate(layers):
        ask("show", {"floor_id": floor, "layer": layer, "walks": k % 2 == 0, "camera": poses[k % 2]})
    for k in range(3):
        place = {"floor_id": floor, "position_m": [40.0 + k, 30.0, 1.2]}
        path_m = [[40.0 + 0.1 * n, 30.0 + k, 1.2] for n in range(400)]
        ask("mark", {"modes": [place | {"probability": 0.5}], "ellipses": [place | {"covariance_m2": [[1, 0], [0, 1]]}],
                     "paths": [{"floor_id": floor, "kind": "estimate", "points_m": path_m}]})  # fmt: skip
    ask("mark", {})
    for camera in ("top", "oblique"):
        ask("show", {"floor_id": floor, "camera": camera})
    return len(layers) + 6


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--switches", type=int, default=300)
    switches = parser.parse_args().switches
    with TemporaryDirectory() as scratch, sync_playwright() as playwright:
        floor = fill(Path(scratch) / "floor", 120.0, 110.0)
        browser = playwright.chromium.launch(executable_path="/usr/bin/chromium", args=CHROMIUM)
        with Server(Path(scratch) / "floor") as server:
            page = browser.new_context(viewport={"width": 1280, "height": 720}).new_page()
            sign_in = f"{server.url}/view/session"
            page.context.request.post(sign_in, form={"key": KEY}, headers={"Origin": server.url}, max_redirects=0)
            page.goto(f"{server.url}/view/?floor={floor}")
            page.locator("#legend .legend-of").first.wait_for()
            session = page.context.new_cdp_session(page)
            done, rows, start = 0, [], time.perf_counter()
            while done < switches:
                done += a_round(page, floor)
                session.send("HeapProfiler.collectGarbage")
                heap = session.send("Runtime.getHeapUsage")["usedSize"] / 2**20
                whole = sum(rss_mb(int(p.name)) for p in Path("/proc").glob("[0-9]*") if is_chromium(p))
                rows.append((rss_mb(server.process.pid), heap, whole))
                print(f"{done:5d} switches, {time.perf_counter() - start:4.0f} s: server {rows[-1][0]:.0f} MB, "
                      f"page's heap {heap:.1f} MB, browser {whole:.0f} MB", flush=True)  # fmt: skip
        browser.close()
    third = max(1, len(rows) // 3)
    early, late = np.mean(rows[third : 2 * third], axis=0), np.mean(rows[-third:], axis=0)
    for name, a, b in zip(("server", "page's heap", "browser"), early, late, strict=True):
        print(f"{name}: {a:.1f} -> {b:.1f} MB, ratio {b / a:.3f}")
    sys.exit(bool((late > CLAIMED * early).any()))


def is_chromium(process: Path) -> bool:
    """The browser's first process: the others are its children."""
    try:
        command = (process / "cmdline").read_bytes()
    except OSError:
        return False
    return b"chromium" in command and b"--type=" not in command and b"--headless" in command


if __name__ == "__main__":
    main()
