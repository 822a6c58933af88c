"""Node that identifies friction from recordings."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict
from pathlib import Path
import sys
from typing import Any

from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from needle_dynamics.base_node import LATCHED, NeedleNode, run
from needle_dynamics.errors import NeedleError
from needle_identification.bag_io import check_distinct, read_friction_recording
from needle_identification.friction import (
    FrictionEstimate,
    FrictionSettings,
    FrictionSummary,
    identify_friction,
    Statistic,
    summarize,
)
from needle_identification.result import write_result
from std_srvs.srv import Trigger


class IdentificationNode(NeedleNode):
    """
    Publishes ``friction`` (latched) from the recordings named in ``bags``.

    It identifies when it is activated with recordings, and whenever ``~/identify`` is called.
    """

    def __init__(self, **node_options: Any) -> None:
        super().__init__('identification', **node_options)
        # An empty list would have no type.
        self.declare_text('bags', [''], 'recordings to identify from')
        self.declare_text('output', '', 'parameter file to write the result to; none if empty')
        self.declare_text('wrench_topic', '', 'topic of the force; found by its type if empty')
        self.declare_text('motion_topic', '', 'topic of the motion; found by its type if empty')
        self.declare_text('force_axis', 'y', 'component of the force that points into the tissue')
        self.declare_text('joint', 'insertion', 'joint whose position is the inserted length [m]')
        self.declare_settings('friction.', FrictionSettings())
        self._summary: FrictionSummary | None = None
        self._friction = self.create_publisher(DiagnosticArray, 'friction', LATCHED)
        self.create_service(Trigger, '~/identify', self._on_identify)

    def configure(self) -> None:
        """Read what to identify from and how."""
        self._bags = [Path(bag) for bag in self.get_parameter('bags').value if bag]
        self._output = self.text('output')
        self._settings = self.settings('friction.', FrictionSettings)

    def activate(self) -> None:
        """Identify, if there is something to identify from."""
        if self._bags:
            self._identify()

    def diagnose(self) -> tuple[bytes, str, dict[str, object]]:
        """Report the last result."""
        if self._summary is None:
            return DiagnosticStatus.OK, 'nothing identified yet', {}
        return DiagnosticStatus.OK, _sentence(self._summary), {}

    def _on_identify(
        self, _request: Trigger.Request, response: Trigger.Response
    ) -> Trigger.Response:
        try:
            response.message = _sentence(self._identify())
            response.success = True
        except NeedleError as error:
            response.message = str(error)
            self.get_logger().error(response.message)
        return response

    def _identify(self) -> FrictionSummary:
        check_distinct(self._bags)
        estimates: list[FrictionEstimate] = []
        for bag in self._bags:
            recording = read_friction_recording(
                bag,
                wrench_topic=self.text('wrench_topic') or None,
                motion_topic=self.text('motion_topic') or None,
                force_axis=self.text('force_axis'),
                joint=self.text('joint'),
            )
            for loss in recording.losses:
                self.get_logger().warning(f'{bag}: {loss}')
            estimates.append(identify_friction(recording, self._settings))
        summary = summarize(estimates)
        if self._output:
            write_result(Path(self._output), summary)
        self._friction.publish(self._message(summary))
        self._summary = summary
        self.get_logger().info(_sentence(summary))
        return summary

    def _message(self, summary: FrictionSummary) -> DiagnosticArray:
        message = DiagnosticArray()
        message.header.stamp = self.get_clock().now().to_msg()
        samples = sum(estimate.samples for estimate in summary.estimates)
        for name, unit, statistic in (
            ('coulomb_friction', 'N', summary.coulomb),
            ('viscous_friction', 'N s/m', summary.viscous),
        ):
            low, high = statistic.interval
            values = {
                'estimate': statistic.mean,
                'interval_low': low,
                'interval_high': high,
                'unit': unit,
                'standard_error': statistic.error,
                'standard_deviation': statistic.deviation,
                'recordings': len(summary.estimates),
                'samples': samples,
            }
            message.status.append(_status(name, _words(statistic, unit), values))
        for estimate in summary.estimates:
            quality = asdict(estimate)
            name = quality.pop('name')
            message.status.append(_status(name, f'R^2 = {estimate.determination:.4f}', quality))
        return message


def _status(name: str, words: str, values: Mapping[str, object]) -> DiagnosticStatus:
    return DiagnosticStatus(
        level=DiagnosticStatus.OK,
        name=name,
        message=words,
        values=[
            KeyValue(key=key, value=str(value))
            for key, value in values.items()
            if value is not None
        ],
    )


def _words(statistic: Statistic, unit: str) -> str:
    low, high = statistic.interval
    return f'{statistic.mean:.4g} +- {(high - low) / 2.0:.2g} {unit}'


def _sentence(summary: FrictionSummary) -> str:
    return (
        f'mu_s = {_words(summary.coulomb, "N")}, mu_v = {_words(summary.viscous, "N s/m")} '
        f'from {len(summary.estimates)} recordings'
    )


def main() -> int:
    """Run the node."""
    return run(IdentificationNode)


if __name__ == '__main__':
    sys.exit(main())
