"""Write ``dentine.yaml``, the Kubernetes manifests of the system that ``compose.yaml`` describes; the compose file is
the only source of its values.

    python deploy/kubernetes/render.py            writes the file
    python deploy/kubernetes/render.py --check    exit status 1 where the file is not what would be written

This module states the differences between the two. Each service is a Deployment of one pod (the worker of two, a fixed
number, because Dask's scaling under load loses work), each volume a claim, each network a policy that admits only pods
of the same network (``front``: everybody, to the api's port), and ``secrets`` the first container of the api's pod. The
other pods restart until this container has made the secrets that they need.
"""

from __future__ import annotations

import re
import sys
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import yaml

HERE = Path(__file__).parent
COMPOSE, MANIFESTS = HERE.parent / "compose.yaml", HERE / "dentine.yaml"
NAMESPACE = "dentine"
REPLICAS = {"worker": 2}
PORTS = {"api": 8000, "scheduler": 8786, "postgres": 5432, "dome": 5020}
SIZES = {"data": "200Gi", "database": "10Gi", "kernels": "2Gi"}
"""Volume -> size of its claim; the other volumes hold some kilobytes."""
SHARED = "ReadWriteMany"
"""Access mode of claims, because pods of several nodes write captures and results."""
USER = 10001
"""Id of the user in the images."""
HEADER = "# Written by deploy/kubernetes/render.py from deploy/compose.yaml; change that file, not this one.\n"


def render(composed: Mapping[str, Any]) -> str:
    """The manifests of a compose file, as one text."""
    services = {name: one for name, one in composed["services"].items() if "profiles" not in one and name != "secrets"}
    volumes = sorted(
        {volume for one in composed["services"].values() if "profiles" not in one for volume in _named_volumes(one)}
    )
    networks = sorted({network for one in services.values() for network in one["networks"]})
    documents = [
        {"apiVersion": "v1", "kind": "Namespace", "metadata": {"name": NAMESPACE}},
        *(_claim(volume) for volume in volumes),
        *(_policy(network) for network in networks),
        *(_deployment(name, one, composed["services"]["secrets"]) for name, one in services.items()),
        *(_service(name) for name in services if name in PORTS),
    ]
    return HEADER + yaml.safe_dump_all(documents, sort_keys=False, width=120)


def _meta(name: str, **labels: str) -> dict[str, Any]:
    return {"name": name, "namespace": NAMESPACE, "labels": {"app.kubernetes.io/part-of": "dentine", **labels}}


def _claim(volume: str) -> dict[str, Any]:
    size = {"requests": {"storage": SIZES.get(volume, "1Gi")}}
    modes = ["ReadWriteOnce"] if volume == "database" else [SHARED]
    return {
        "apiVersion": "v1",
        "kind": "PersistentVolumeClaim",
        "metadata": _meta(volume),
        "spec": {"accessModes": modes, "resources": size},
    }


def _policy(network: str) -> dict[str, Any]:
    selector = {"matchLabels": {f"network-{network}": "member"}}
    allowed = {"ports": [{"port": PORTS["api"]}]} if network == "front" else {"from": [{"podSelector": selector}]}
    spec = {"podSelector": selector, "policyTypes": ["Ingress"], "ingress": [allowed]}
    return {"apiVersion": "networking.k8s.io/v1", "kind": "NetworkPolicy", "metadata": _meta(network), "spec": spec}


def _service(name: str) -> dict[str, Any]:
    ports = [{"port": PORTS[name], "targetPort": PORTS[name]}]
    return {
        "apiVersion": "v1",
        "kind": "Service",
        "metadata": _meta(name),
        "spec": {"selector": {"app": name}, "ports": ports},
    }


def _deployment(name: str, service: Mapping[str, Any], secrets: Mapping[str, Any]) -> dict[str, Any]:
    labels = {"app": name, **{f"network-{network}": "member" for network in service["networks"]}}
    pod: dict[str, Any] = {
        "automountServiceAccountToken": False,
        "enableServiceLinks": False,
        "terminationGracePeriodSeconds": int(service.get("stop_grace_period", "10s").rstrip("s")),
    }
    if name != "postgres":
        pod["securityContext"] = {"runAsUser": USER, "runAsGroup": USER, "runAsNonRoot": True, "fsGroup": USER}
    if name == "api":
        pod["initContainers"] = [_container("secrets", secrets)]
    pod["containers"] = [_container(name, service)]
    mounted = [service, secrets] if name == "api" else [service]
    pod["volumes"] = list(_volumes(mounted))
    return {
        "apiVersion": "apps/v1",
        "kind": "Deployment",
        "metadata": _meta(name, app=name),
        "spec": {
            "replicas": REPLICAS.get(name, 1),
            "strategy": {"type": "Recreate"},
            "selector": {"matchLabels": {"app": name}},
            "template": {"metadata": {"labels": labels}, "spec": pod},
        },
    }


def _container(name: str, service: Mapping[str, Any]) -> dict[str, Any]:
    environment = [{"name": key, "value": _default(value)} for key, value in service.get("environment", {}).items()]
    rights = {"drop": ["ALL"]} | ({"add": service["cap_add"]} if "cap_add" in service else {})
    container: dict[str, Any] = {"name": name, "image": _default(service["image"]), "imagePullPolicy": "IfNotPresent"}
    if "command" in service:
        container["args"] = [_default(part) for part in service["command"]]
    if environment:
        container["env"] = environment
    if name in PORTS:
        container["ports"] = [{"containerPort": PORTS[name]}]
    if "healthcheck" in service:
        check = service["healthcheck"]
        probe = {
            "exec": {"command": check["test"][1:]},
            "periodSeconds": _seconds(check["interval"]),
            "timeoutSeconds": _seconds(check["timeout"]),
        }
        container["startupProbe"] = probe | {"failureThreshold": 60}
        container["livenessProbe"] = probe | {"failureThreshold": check["retries"]}
    if "mem_limit" in service:
        container["resources"] = {
            "limits": {"memory": _default(service["mem_limit"]).replace("m", "Mi").replace("g", "Gi")}
        }
    container["securityContext"] = {
        "readOnlyRootFilesystem": True,
        "allowPrivilegeEscalation": False,
        "capabilities": rights,
    }
    container["volumeMounts"] = list(_mounts(service))
    return container


def _mounts(service: Mapping[str, Any]) -> Iterator[dict[str, Any]]:
    for path in service.get("tmpfs", []):
        yield {"name": _memory_name(path), "mountPath": path}
    for volume in service.get("volumes", []):
        name, path, *mode = volume.split(":")
        yield {"name": name, "mountPath": path} | ({"readOnly": True} if mode == ["ro"] else {})


def _volumes(services: list[Mapping[str, Any]]) -> Iterator[dict[str, Any]]:
    for path in sorted({path for one in services for path in one.get("tmpfs", [])}):
        yield {"name": _memory_name(path), "emptyDir": {"medium": "Memory"}}
    for name in sorted({name for one in services for name in _named_volumes(one)}):
        yield {"name": name, "persistentVolumeClaim": {"claimName": name}}


def _named_volumes(service: Mapping[str, Any]) -> Iterator[str]:
    return (volume.split(":")[0] for volume in service.get("volumes", []) if volume[0] not in "./$")


def _memory_name(path: str) -> str:
    return "memory" + path.replace("/", "-")


def _seconds(text: str) -> int:
    return int(text.removesuffix("s"))


def _default(text: Any) -> str:
    """A value whose variables are replaced by their defaults, innermost first."""
    before, after = None, str(text)
    while after != before:
        before, after = after, re.sub(r"\$\{\w+(?::-([^${}]*)|:\+[^{}]*)?\}", lambda found: found[1] or "", after)
    return after


def main() -> int:
    """Write or check the file."""
    text = render(yaml.safe_load(COMPOSE.read_text()))
    if "--check" in sys.argv[1:]:
        return int(text != MANIFESTS.read_text())
    MANIFESTS.write_text(text)
    return 0


if __name__ == "__main__":
    sys.exit(main())
