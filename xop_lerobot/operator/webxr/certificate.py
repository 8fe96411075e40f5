"""Self-signed TLS certificate of this machine, created on first use.

It is valid for the machine's own names and addresses only; its private key never leaves the user's
folder.
"""

from __future__ import annotations

import contextlib
import datetime
import fcntl
import ipaddress
import logging
import os
import ssl
import stat
import tempfile
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path

from cryptography import x509
from cryptography.hazmat.primitives import hashes, serialization
from cryptography.hazmat.primitives.asymmetric import ec
from cryptography.x509.oid import ExtendedKeyUsageOID, NameOID

from xop_lerobot.core.errors import XopError
from xop_lerobot.operator.webxr.addresses import LOOPBACKS, list_addresses, list_names

logger = logging.getLogger(__name__)

VALID = datetime.timedelta(days=397)
"""Longest validity that Apple's systems accept."""
RENEW = datetime.timedelta(days=30)
"""Remaining validity at which it is renewed."""
SKEW = datetime.timedelta(hours=1)
"""Tolerated lag of a headset's clock."""
MAX_NAMES = 64
"""Largest number of names and addresses in it."""


class CertificateFault(XopError):
    """The certificate cannot be created or read; the message names the folder."""


@dataclass(frozen=True)
class Certificate:
    """A certificate and its key.

    Attributes:
        path: File of the certificate (PEM).
        key_path: File of its private key (PEM), readable by its user only.
        names: Names and addresses for which it is valid.
        end: End of its validity.
        fingerprint: Its SHA-256 as pairs of hexadecimal digits, as browsers show it.
    """

    path: Path
    key_path: Path
    names: frozenset[str]
    end: datetime.datetime
    fingerprint: str

    def make_context(self) -> ssl.SSLContext:
        """Make the server's TLS context."""
        context = ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER)
        context.minimum_version = ssl.TLSVersion.TLSv1_2
        context.load_cert_chain(self.path, self.key_path)
        return context


def find_folder() -> Path:
    """Return the folder of the certificate."""
    base = os.environ.get("XDG_CONFIG_HOME") or Path.home() / ".config"
    return Path(base) / "xop-lerobot"


def list_own_names() -> frozenset[str]:
    """Return all present names and addresses of this machine."""
    return frozenset([*list_names(), *LOOPBACKS, *list_addresses()][:MAX_NAMES])


def get_certificate(
    folder: Path | None = None,
    names: Iterable[str] | None = None,
    now: datetime.datetime | None = None,
) -> Certificate:
    """Return this machine's certificate; create one if none is valid.

    A new one is created when a name or address is missing in it, when it ends within 30 days, when
    it does not match its key, and when others could have read the key.

    Args:
        folder: Its folder; None for the user's own.
        names: Names for which it must be valid; None for all of this machine.
        now: Present time; None to read the clock.

    Raises:
        CertificateFault: If the folder cannot be used.
    """
    folder = folder or find_folder()
    names = list_own_names() if names is None else frozenset(names)
    now = now or datetime.datetime.now(datetime.UTC)
    try:
        folder.mkdir(parents=True, exist_ok=True, mode=0o700)
        with _hold(folder):
            found, fault = inspect_certificate(folder, names, now)
            if found is None:
                logger.info("A new certificate is made in %s: %s.", folder, fault)
                _write(folder, names, now)
                found, fault = inspect_certificate(folder, names, now)
    except OSError as error:
        raise CertificateFault(f"certificate in '{folder}': {error.strerror or error}") from error
    if found is None:
        raise CertificateFault(f"certificate in '{folder}': {fault}")
    return found


def inspect_certificate(
    folder: Path, names: frozenset[str], now: datetime.datetime
) -> tuple[Certificate | None, str]:
    """Return the certificate of a folder, or None and its fault; changes nothing."""
    path, key_path = folder / "webxr.crt", folder / "webxr.key"
    if not (path.exists() and key_path.exists()):
        return None, "there is none yet"
    if key_path.stat().st_mode & (stat.S_IRWXG | stat.S_IRWXO):
        return None, "others could read its key"
    try:
        parsed = x509.load_pem_x509_certificate(path.read_bytes())
        key = serialization.load_pem_private_key(key_path.read_bytes(), password=None)
        held = _read_names(parsed)
    except (ValueError, TypeError, x509.ExtensionNotFound):
        return None, "it cannot be read"
    end = parsed.not_valid_after_utc
    fault = ""
    if key.public_key() != parsed.public_key():
        fault = "it does not belong to its key"
    elif not parsed.not_valid_before_utc <= now < end - RENEW:
        fault = f"the old one ends on {end:%Y-%m-%d}"
    elif names - held:
        fault = f"the old one does not hold {', '.join(sorted(names - held))}"
    digest = parsed.fingerprint(hashes.SHA256()).hex(":").upper()
    return None if fault else Certificate(path, key_path, held, end, digest), fault


def _read_names(parsed: x509.Certificate) -> frozenset[str]:
    held = parsed.extensions.get_extension_for_class(x509.SubjectAlternativeName).value
    addresses = held.get_values_for_type(x509.IPAddress)
    return frozenset([*held.get_values_for_type(x509.DNSName), *map(str, addresses)])


def _write(folder: Path, names: frozenset[str], now: datetime.datetime) -> None:
    key = ec.generate_private_key(ec.SECP256R1())
    made = _sign(key, names, now)
    secret = key.private_bytes(
        serialization.Encoding.PEM,
        serialization.PrivateFormat.PKCS8,
        serialization.NoEncryption(),
    )
    _replace(folder / "webxr.key", secret, 0o600)
    _replace(folder / "webxr.crt", made.public_bytes(serialization.Encoding.PEM), 0o644)


def _sign(
    key: ec.EllipticCurvePrivateKey, names: frozenset[str], now: datetime.datetime
) -> x509.Certificate:
    addresses = [ipaddress.ip_address(name) for name in sorted(names) if _is_address(name)]
    hosts = [name for name in sorted(names) if not _is_address(name)]
    subject = x509.Name([x509.NameAttribute(NameOID.COMMON_NAME, "xop-lerobot (this machine)")])
    usage = x509.KeyUsage(
        digital_signature=True,
        key_cert_sign=True,
        content_commitment=False,
        key_encipherment=False,
        data_encipherment=False,
        key_agreement=False,
        crl_sign=False,
        encipher_only=False,
        decipher_only=False,
    )
    # Apple's headsets let users trust certificate authorities only, so it is one; the name
    # constraints restrict it to this machine.
    constraints = x509.NameConstraints(
        permitted_subtrees=[
            *map(x509.DNSName, hosts),
            *(x509.IPAddress(ipaddress.ip_network(address)) for address in addresses),
        ],
        excluded_subtrees=None,
    )
    alternatives = [*map(x509.DNSName, hosts), *map(x509.IPAddress, addresses)]
    return (
        x509.CertificateBuilder()
        .subject_name(subject)
        .issuer_name(subject)
        .public_key(key.public_key())
        .serial_number(x509.random_serial_number())
        .not_valid_before(now - SKEW)
        .not_valid_after(now - SKEW + VALID)
        .add_extension(x509.BasicConstraints(ca=True, path_length=0), critical=True)
        .add_extension(constraints, critical=True)
        .add_extension(usage, critical=True)
        .add_extension(x509.ExtendedKeyUsage([ExtendedKeyUsageOID.SERVER_AUTH]), critical=False)
        .add_extension(x509.SubjectAlternativeName(alternatives), critical=False)
        .add_extension(x509.SubjectKeyIdentifier.from_public_key(key.public_key()), critical=False)
        .sign(key, hashes.SHA256())
    )


def _is_address(name: str) -> bool:
    try:
        ipaddress.ip_address(name)
    except ValueError:
        return False
    return True


def _replace(path: Path, data: bytes, mode: int) -> None:
    """Replace a file atomically, never readable by others before it has its mode."""
    handle, name = tempfile.mkstemp(dir=path.parent)  # mode 0600
    try:
        with os.fdopen(handle, "wb") as file:
            file.write(data)
            os.fchmod(file.fileno(), mode)
        Path(name).replace(path)
    except BaseException:
        Path(name).unlink(missing_ok=True)
        raise


@contextlib.contextmanager
def _hold(folder: Path) -> Iterator[None]:
    """Lock the folder, so that one process at a time creates a certificate."""
    with (folder / "webxr.lock").open("w") as file:
        fcntl.flock(file, fcntl.LOCK_EX)
        yield
