"""From bags to a latched result and a parameter file that other nodes take."""

from diagnostic_msgs.msg import DiagnosticArray
from identification.samples import NOISY, simulated, TRUTH, write_bag
from needle_dynamics.base_node import LATCHED
from needle_identification.identification_node import IdentificationNode
import pytest
from rclpy.node import Node
from std_srvs.srv import Trigger


@pytest.fixture(scope='module')
def bags(tmp_path_factory):
    """Return three recordings of the simulated needle."""
    folder = tmp_path_factory.mktemp('bags')
    paths = [folder / f'run_{seed}' for seed in range(3)]
    for seed, path in enumerate(paths):
        write_bag(path, simulated(sensor=NOISY, seed=seed))
    return [str(path) for path in paths]


def identify(ros_graph):
    client = ros_graph.node('caller').create_client(Trigger, 'identification/identify')
    ros_graph.spin_until(client.service_is_ready, 'the service')
    answer = client.call_async(Trigger.Request())
    ros_graph.spin_until(answer.done, 'the answer')
    return answer.result().success, answer.result().message


def test_identifies_when_activated_and_tells_who_comes_late(ros_graph, bags):
    """The latched result holds estimate, interval, unit, sample count and quality."""
    ros_graph.add(IdentificationNode, parameters={'bags': bags})
    late = ros_graph.listen(ros_graph.node('late'), DiagnosticArray, 'friction', LATCHED)
    ros_graph.spin_until(lambda: late, 'the result')
    status = {s.name: {v.key: v.value for v in s.values} for s in late[0].status}
    assert list(status) == ['coulomb_friction', 'viscous_friction', *bags]
    for name, unit in (('coulomb_friction', 'N'), ('viscous_friction', 'N s/m')):
        values = status[name]
        low, high = float(values['interval_low']), float(values['interval_high'])
        assert low < getattr(TRUTH, name) < high
        assert low < float(values['estimate']) < high
        assert (values['unit'], values['recordings']) == (unit, '3')
        assert int(values['samples']) > 1000
    assert float(status[bags[0]]['determination']) > 0.99


def test_its_result_is_a_parameter_file_for_nodes_in_any_namespace(ros_graph, bags, tmp_path):
    """Rclpy applies the file to plant and controller wherever they are, and to no other node."""
    output = tmp_path / 'friction.yaml'
    ros_graph.add(IdentificationNode, parameters={'bags': bags, 'output': str(output)})
    for name, namespace, expected in (
        ('plant', None, True),
        ('controller', None, True),
        ('plant', '/lab/left', True),
        ('recorder', None, False),
    ):
        node = ros_graph.add(
            Node,
            name,
            namespace=namespace,
            cli_args=['--ros-args', '--params-file', str(output)],
            automatically_declare_parameters_from_overrides=True,
        )
        assert node.has_parameter('model.coulomb_friction') == expected
        if expected:
            value = node.get_parameter('model.viscous_friction').value
            assert value == pytest.approx(TRUTH.viscous_friction, rel=0.01)


def test_the_service_identifies_and_gives_the_reason_when_it_cannot(ros_graph, bags, tmp_path):
    """Failure is an answer of one line, and the node lives on."""
    node = ros_graph.add(IdentificationNode)
    assert identify(ros_graph) == (False, 'no recordings to identify from')
    assert node.is_active


def test_the_service_says_what_it_found(ros_graph, bags):
    """Success is an answer with both coefficients."""
    ros_graph.add(IdentificationNode, parameters={'bags': bags})
    success, message = identify(ros_graph)
    assert success
    assert message.startswith('mu_s = 0.5')
    assert message.endswith('N s/m from 3 recordings')


@pytest.mark.parametrize(
    ('parameters', 'complaint'),
    [
        ({'bags': ['/no/such/bag']}, '/no/such/bag does not exist'),
        ({'friction.cutoff': 0.0}, 'friction.cutoff must be finite, > 0'),
        ({'friction.cutof': 5.0}, "unknown parameter 'friction.cutof'; did you mean 'friction."),
    ],
)
def test_refuses_to_start_and_says_why(ros_graph, parameters, complaint):
    """A node that cannot do what it was asked to does not become active."""
    node = ros_graph.add(IdentificationNode, start=False, parameters=parameters)
    assert not node.start()
    assert complaint in node.failure
