"""Whether the certificate of the headset's page will do."""

from __future__ import annotations

import datetime

from xop_lerobot.doctor.finding import Finding, Level, Setup


def check_certificate(setup: Setup) -> Finding:
    """Look at the certificate; nothing is made or changed."""
    if setup.device == "avp":
        return Finding(Level.SKIP, "a Vision Pro with Tracking Streamer needs none")
    if setup.host in ("", "127.0.0.1", "localhost", "::1"):
        return Finding(Level.SKIP, "on loopback the page needs none")
    from xop_lerobot.operator.webxr.certificate import (  # noqa: PLC0415  brings cryptography
        find_folder,
        inspect_certificate,
        list_own_names,
    )

    folder, now = find_folder(), datetime.datetime.now(datetime.UTC)
    found, fault = inspect_certificate(folder, list_own_names(), now)
    if found is not None:
        days = (found.end - now).days
        return Finding(
            Level.OK,
            f"the certificate in {folder} is valid for {days} days and all addresses of this "
            "machine; its key is its user's alone",
            "",
            {"days": days, "fingerprint": found.fingerprint},
        )
    exists = (folder / "webxr.crt").exists()
    return Finding(
        Level.WARN if exists else Level.OK,
        f"the certificate in {folder}: {fault}; the next session makes one",
        "headsets ask once more whether they shall trust it" if exists else "",
    )
