"""Who may do what on a secured network: certificates of a fleet, and Zenoh's settings that follow from them.

A folder of credentials holds `fleet.toml`, `authority.pem` and, of every party that runs on this machine,
`NAME.pem` and `NAME.key`. Parties are hosts (the agent process of one or several modules), the coordinator
and observers. TLS is mutual: both sides of a link prove that the authority has certified them, and a hub
proves that it may serve: certificates of hosts and observers are good for connecting only. The hub then
allows by the name in the certificate; everything else is denied:

=============  ============================================================================================
a host         publish, answer and be alive on the keys of its own modules; hear what modules publish; ask any
               module for its history; stop any module
coordinator    hear, ask and command every module
observer       hear every module; ask for what changes nothing; stop any module
=============  ============================================================================================
"""

from collections.abc import Sequence
from pathlib import Path
from typing import Any, Literal, NamedTuple

from pydantic import BaseModel, ConfigDict, ValidationError

from module_agent.model.errors import UsageError
from module_agent.model.model_faults import faults_of
from module_agent.model.toml_location import fault_lines, read_toml
from module_agent.wire.keys import ROOT, Leaf
from module_agent.wire.topics import PUBLISHED_BY_MODULE, PUBLISHED_TO_MODULE, SERVED

FLEET = "fleet.toml"
AUTHORITY = "authority"
COORDINATOR = "coordinator"
OBSERVER = "observer"

# What an observer may ask: nothing of it changes a module, but for the stop.
_READ = (Leaf.INFO, Leaf.STATUS, Leaf.HISTORY, Leaf.ESTIMATE, Leaf.STOP)
_EVERYTHING = (
    "put",
    "delete",
    "query",
    "reply",
    "declare_subscriber",
    "declare_queryable",
    "liveliness_token",
    "liveliness_query",
    "declare_liveliness_subscriber",
)

_Flow = Literal["ingress", "egress"]


class Host(BaseModel):
    """An agent process by the name in its certificate, and the serials of the modules that it may run."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    name: str
    serials: tuple[str, ...]


class Fleet(BaseModel):
    """The robot that a folder of credentials is for, the addresses of its hub, and its hosts."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    robot: str
    addresses: tuple[str, ...]
    host: tuple[Host, ...]


class Credentials(NamedTuple):
    """One party's place in a fleet; `name` is that of its certificate."""

    folder: Path
    name: str
    fleet: Fleet

    @property
    def may_serve(self) -> bool:
        """Whether the certificate is good for a hub."""
        return self.name == COORDINATOR

    def settings(self, as_hub: bool) -> dict[str, Any]:
        """Return the settings of a Zenoh session: mutual TLS, and as a hub who may do what.

        Only the hub judges: to all others whatever it passes on comes from the hub.
        """
        pair = {
            "private_key": self.folder / f"{self.name}.key",
            "certificate": self.folder / f"{self.name}.pem",
        }
        tls = {f"{side}_{what}": str(path) for what, path in pair.items() for side in ("connect", "listen")}
        tls |= {"root_ca_certificate": str(self.folder / f"{AUTHORITY}.pem")}
        settings: dict[str, Any] = {f"transport/link/tls/{name}": value for name, value in tls.items()}
        settings["transport/link/tls/enable_mtls"] = True
        settings["transport/link/tls/verify_name_on_connect"] = True
        # No other protocol is spoken, whatever endpoints say.
        settings["transport/link/protocols"] = ["tls"]
        if as_hub:
            settings["access_control"] = access_control(self.fleet)
        return settings


def load_fleet(folder: Path) -> Fleet:
    """Read the description of a fleet.

    Raises:
        UsageError: the folder holds none, or it is malformed.
    """
    path = folder / FLEET
    if not path.exists():
        raise UsageError(
            f"--secure {folder}: no {FLEET} in it; `x5-coordinator keys --out {folder}` makes such a folder"
        )
    table, text = read_toml(path)
    try:
        return Fleet.model_validate(table)
    except ValidationError as error:
        raise UsageError(fault_lines(faults_of(error), text, path)) from error


def load_credentials(folder: Path, robot: str, names: Sequence[str]) -> Credentials:
    """Return the credentials of the first of these parties whose certificate is in the folder.

    Raises:
        UsageError: there is none, or the folder is another robot's.
    """
    fleet = load_fleet(folder)
    if fleet.robot != robot:
        raise UsageError(f"--secure {folder}: made for robot {fleet.robot!r}, this is robot {robot!r}")
    for name in names:
        files = [folder / f"{AUTHORITY}.pem", folder / f"{name}.pem", folder / f"{name}.key"]
        if all(path.is_file() for path in files):
            return Credentials(folder, name, fleet)
    wanted = " or ".join(f"{name}.pem with {name}.key" for name in names)
    raise UsageError(f"--secure {folder}: it needs {AUTHORITY}.pem, and {wanted}")


def host_credentials(folder: Path, robot: str, serials: Sequence[str]) -> Credentials:
    """Return the credentials of an agent process that runs these modules.

    Raises:
        UsageError: no certificate covers them, or its files are not in the folder.
    """
    hosts = [each for each in load_fleet(folder).host if set(serials) <= set(each.serials)]
    if not hosts:
        together = f" --together {','.join(serials)}" if len(serials) > 1 else ""
        raise UsageError(
            f"--secure {folder}: no certificate covers {', '.join(serials)} in one process; "
            f"`x5-coordinator keys --out {folder} {' '.join(serials)}{together}` makes one"
        )
    # The narrowest certificate: a process should be able to do no more than it needs.
    host = min(hosts, key=lambda each: len(each.serials))
    return load_credentials(folder, robot, [host.name])


def secured(endpoint: str) -> str:
    """Return an endpoint for TLS; `tcp/` becomes `tls/`.

    Raises:
        UsageError: another protocol.
    """
    protocol, _, address = endpoint.partition("/")
    if protocol not in ("tcp", "tls"):
        raise UsageError(f"endpoint {endpoint!r}: with --secure it must be tls/HOST:PORT")
    return f"tls/{address}"


def access_control(fleet: Fleet) -> dict[str, Any]:
    """Return Zenoh's configuration of access control: denied unless a rule of the sender's name allows it."""
    rules: list[dict[str, Any]] = []
    policies: list[dict[str, Any]] = []

    def keys(serials: Sequence[str], leaves: Sequence[Leaf]) -> list[str]:
        return [f"{ROOT}/{fleet.robot}/{serial}/{leaf.value}" for serial in serials for leaf in leaves]

    def allow(name: str, *allowed: tuple[Sequence[str], Sequence[str]], flow: _Flow = "ingress") -> None:
        first = len(rules)
        for messages, expressions in allowed:
            rules.append(
                {
                    "id": f"{name}-{len(rules)}",
                    "permission": "allow",
                    "flows": [flow],
                    "messages": list(messages),
                    "key_exprs": list(expressions),
                }
            )
        policies.append({"rules": [rule["id"] for rule in rules[first:]], "subjects": [name]})

    stop, alive = keys("*", [Leaf.STOP]), keys("*", [Leaf.ALIVE])
    hear = (["declare_subscriber"], keys("*", PUBLISHED_BY_MODULE))
    watch = (["declare_liveliness_subscriber", "liveliness_query"], alive)
    for host in fleet.host:
        own = host.serials
        allow(
            host.name,
            (["put"], keys(own, PUBLISHED_BY_MODULE) + stop),
            (["reply", "declare_queryable"], keys(own, SERVED)),
            (["liveliness_token"], keys(own, [Leaf.ALIVE])),
            (["declare_subscriber"], keys(own, PUBLISHED_TO_MODULE)),
            hear,
            (["query"], keys("*", [Leaf.HISTORY]) + stop),
        )
    allow(COORDINATOR, (["put"], keys("*", PUBLISHED_TO_MODULE)), (["query"], keys("*", SERVED)), hear, watch)
    allow(OBSERVER, (["put"], stop), (["query"], keys("*", _READ)), hear, watch)
    names = [*(host.name for host in fleet.host), COORDINATOR, OBSERVER]
    # What the hub passes on was allowed when it came in, and goes to those who were allowed to declare it.
    for name in names:
        allow(name, (_EVERYTHING, [f"{ROOT}/{fleet.robot}/**"]), flow="egress")
    return {
        "enabled": True,
        "default_permission": "deny",
        "rules": rules,
        "subjects": [{"id": name, "cert_common_names": [name]} for name in names],
        "policies": policies,
    }
