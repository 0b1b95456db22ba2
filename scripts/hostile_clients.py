#!/usr/bin/env python3
# SPDX-License-Identifier: MIT OR Apache-2.0
"""Clients that a node must survive while it records: eight consoles, slow readers, a flood, garbage, oversized bodies.

    hostile_clients.py PORT SECONDS

Prints what was answered, by kind and status, as one JSON object. Standard library only.
"""

import collections
import json
import socket
import sys
import threading
import time

PORT, SECONDS = int(sys.argv[1]), float(sys.argv[2])
END = time.monotonic() + SECONDS
counts = collections.Counter()
lock = threading.Lock()


def count(kind, what):
    with lock:
        counts[f"{kind}_{what}"] += 1


def request(line, headers="", body=b""):
    head = f"{line} HTTP/1.1\r\nHost: 127.0.0.1:{PORT}\r\nConnection: close\r\n{headers}\r\n"
    return head.encode() + body


def exchange(kind, data, read=True):
    """One connection: sends, reads to the end, counts the status."""
    try:
        with socket.create_connection(("127.0.0.1", PORT), timeout=10) as peer:
            peer.sendall(data)
            answer = peer.recv(65536) if read else b""
            while read and peer.recv(65536):
                pass
            status = answer.split(b" ")[1].decode() if answer.startswith(b"HTTP/1.1 ") else "closed"
            count(kind, status)
    except OSError:
        count(kind, "refused")


def repeat(kind, data, pause):
    while time.monotonic() < END:
        exchange(kind, data)
        time.sleep(pause)


def console():
    """What a console's page asks, as often as it asks."""
    while time.monotonic() < END:
        for path in ("status", "capture", "previews", "previews/h0_up", "previews/h0_low", "previews/h1_up", "previews/h1_low", "live", "live/rows/8", "playable", "sessions/walk/frame-sets", "sessions/walk/frame-sets/0"):
            exchange("console", request(f"GET /api/v1/{path}"))
        time.sleep(0.4)


def slow_reader():
    """Asks for pictures in one go and reads nothing."""
    while time.monotonic() < END:
        try:
            with socket.create_connection(("127.0.0.1", PORT), timeout=10) as peer:
                peer.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 2048)
                head = f"GET /api/v1/previews/h0_up HTTP/1.1\r\nHost: 127.0.0.1:{PORT}\r\n\r\n".encode()
                peer.sendall(head * 50)
                time.sleep(min(4.0, max(0.0, END - time.monotonic())))
                count("slow_reader", "held")
        except OSError:
            count("slow_reader", "refused")


def slow_writer():
    """A head that never ends."""
    while time.monotonic() < END:
        try:
            with socket.create_connection(("127.0.0.1", PORT), timeout=10) as peer:
                peer.sendall(b"GET /api/v1/status HTTP/1.1\r\n")
                while time.monotonic() < END:
                    peer.sendall(b"X-More: 1\r\n")
                    time.sleep(0.2)
        except OSError:
            count("slow_writer", "cut")


def main():
    big = request("POST /api/v1/session/prepare", "Content-Type: application/json\r\nContent-Length: 100000000\r\n", b"x" * 200_000)
    jobs = [(console, ())] * 8 + [(slow_reader, ())] * 8 + [(slow_writer, ())] * 8
    jobs += [(repeat, ("flood", request("GET /api/v1/status"), 0.0))] * 4
    jobs += [(repeat, ("garbage", bytes(range(256)) * 64, 0.01)), (repeat, ("oversized", big, 0.05))]
    jobs += [(repeat, ("rebinding", b"GET /api/v1/status HTTP/1.1\r\nHost: evil.example\r\n\r\n", 0.01))]
    threads = [threading.Thread(target=job, args=args, daemon=True) for job, args in jobs]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join(SECONDS + 30)
    print(json.dumps(dict(sorted(counts.items()))))


main()
