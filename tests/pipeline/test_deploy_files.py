"""The files of ``deploy/`` pass the validators of their formats, and each validator is shown to find a fault."""

from __future__ import annotations

import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest
import yaml

DEPLOY = Path(__file__).parents[2] / "deploy"
COMPOSED = sorted(DEPLOY.glob("compose*.yaml"))
RENDER = DEPLOY / "kubernetes" / "render.py"
MONITORING = DEPLOY / "monitoring"


def compose_schema(file: Path) -> int:
    return subprocess.run(
        [sys.executable, "-m", "check_jsonschema", "--builtin-schema", "vendor.compose-spec", str(file)],
        capture_output=True,
        check=False,
    ).returncode


def kubernetes(file: Path) -> int:
    program = Path(sys.executable).with_name("kubernetes-validate")
    return subprocess.run([str(program), "--strict", "--quiet", str(file)], capture_output=True, check=False).returncode


def promtool(*arguments: str, cwd: Path) -> int:
    program = shutil.which("promtool") or pytest.skip(
        "promtool is not installed; Debian's package prometheus brings it."
    )
    return subprocess.run([program, *arguments], cwd=cwd, capture_output=True, check=False).returncode


@pytest.mark.parametrize("file", COMPOSED, ids=lambda file: file.name)
def test_compose_files_follow_the_specification(file: Path, tmp_path: Path) -> None:
    plain = tmp_path / file.name  # the schema does not know compose's tag ``!reset``
    plain.write_text(file.read_text().replace("!reset", ""))
    assert compose_schema(plain) == 0
    plain.write_text(plain.read_text().replace("read_only:", "readonly:").replace("network_mode:", "networkmode:"))
    assert compose_schema(plain) != 0


def test_the_manifests_are_those_of_the_compose_file(tmp_path: Path) -> None:
    assert subprocess.run([sys.executable, str(RENDER), "--check"], check=False).returncode == 0
    copy = shutil.copytree(DEPLOY, tmp_path / "deploy")
    changed = copy / "compose.yaml"
    changed.write_text(changed.read_text().replace("--port=5020", "--port=5021"))
    assert (
        subprocess.run([sys.executable, str(copy / "kubernetes" / "render.py"), "--check"], check=False).returncode == 1
    )


def test_the_manifests_are_valid(tmp_path: Path) -> None:
    manifests = DEPLOY / "kubernetes" / "dentine.yaml"
    assert kubernetes(manifests) == 0
    broken = tmp_path / "broken.yaml"
    broken.write_text(manifests.read_text().replace("readOnlyRootFilesystem", "readOnlyRootFileSystem", 1))
    assert kubernetes(broken) != 0


def test_the_manifests_name_nothing_that_is_left_to_a_variable() -> None:
    assert "${" not in (DEPLOY / "kubernetes" / "dentine.yaml").read_text()


def test_every_alarm_is_raised_by_its_test(tmp_path: Path) -> None:
    assert promtool("test", "rules", "alerts.test.yml", cwd=MONITORING) == 0
    rules = (MONITORING / "alerts.yml").read_text()
    shutil.copy(MONITORING / "alerts.test.yml", tmp_path)
    alarms = re.findall(r"alert: (\w+)", rules)
    expressions = re.findall(r"expr: (.*)", rules)
    assert len(alarms) == len(expressions) >= 8
    for expression in expressions:
        (tmp_path / "alerts.yml").write_text(rules.replace(expression, "vector(0) > 1"))
        assert promtool("test", "rules", "alerts.test.yml", cwd=tmp_path) != 0, expression


def test_the_runbook_has_every_alarm() -> None:
    runbook = (DEPLOY.parent / "docs" / "use" / "operation.md").read_text()
    for alarm in re.findall(r"alert: (\w+)", (MONITORING / "alerts.yml").read_text()):
        assert f"`{alarm}`" in runbook, alarm


def test_prometheus_takes_its_configuration(tmp_path: Path) -> None:
    assert promtool("check", "config", "--syntax-only", "prometheus.yml", cwd=MONITORING) == 0
    (tmp_path / "prometheus.yml").write_text(
        (MONITORING / "prometheus.yml").read_text().replace("metrics_path", "metric_path")
    )
    assert promtool("check", "config", "--syntax-only", "prometheus.yml", cwd=tmp_path) != 0


def test_the_curves_ask_for_metrics_that_the_server_has() -> None:
    told = yaml.safe_load((MONITORING / "grafana" / "dashboards" / "dentine.json").read_text())
    asked = {
        name
        for panel in told["panels"]
        for target in panel["targets"]
        for name in re.findall(r"dentine_\w+", target["expr"])
    }
    api = DEPLOY.parent / "services" / "api"
    source = "".join((api / name).read_text() for name in ("health/metrics.py", "http/request_metrics.py"))
    for name in asked:
        assert f'"{re.sub("_(total|bucket)$", "", name)}"' in source, name
