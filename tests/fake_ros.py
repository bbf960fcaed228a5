"""A small stand-in for rclpy and its message packages, as strict about types as generated message classes are.

It holds what `rclpy_transport` uses, with the names and arguments of rclpy's documentation. Nodes of one process reach
each other; nothing is proven about a real rclpy.
"""

import array
import sys
import types
from collections import defaultdict, deque

from jaxdrones.ros2 import messages as msg

INTEGERS = {"uint8": (0, 2**8), "uint32": (0, 2**32), "int32": (-(2**31), 2**31)}


def message_class(kind):
    def check(field, value):
        if field.is_message:
            entries = [value] if field.length is None else value
            assert all(type(entry) is classes[field.kind] for entry in entries), (kind, field.name)
        elif field.length is None:
            wanted = {"string": str, "bool": bool, "float64": float, "float32": float}.get(field.kind, int)
            assert type(value) is wanted, (kind, field.name, value)
            if field.kind in INTEGERS:
                low, high = INTEGERS[field.kind]
                assert low <= value < high
        elif field.length:
            assert isinstance(value, list) and len(value) == field.length
            assert all(isinstance(x, float) for x in value)
        else:
            code = {"uint8": "B", "float32": "f", "float64": "d"}[field.kind]
            assert isinstance(value, array.array) and value.typecode == code

    class Generated:
        def __init__(self, **given):
            assert set(given) <= {field.name for field in msg.fields(kind)}
            for field in msg.fields(kind):
                default = getattr(msg.message_class(kind)(), field.name)
                if field.is_message and field.length is None and field.name not in given:
                    default = msg.encode(default, classes.__getitem__, None)
                value = given.get(field.name, default)
                if field.name in given:
                    check(field, value)
                setattr(self, field.name, value)

    Generated.__name__ = kind.rpartition("/")[2]
    Generated.NAME = kind
    return Generated


classes = {name: message_class(name) for name in msg.MESSAGES}


class Trigger:
    NAME = "std_srvs/srv/Trigger"

    class Request:
        pass

    class Response:
        success, message = False, ""


class Graph:
    """Everything that the nodes of one process share."""

    def __init__(self):
        self.running = False
        self.ends = defaultdict(list)  # topic -> (type, publishes)
        self.readers = defaultdict(list)
        self.services = {}


class Future:
    answer = None

    def done(self):
        return self.answer is not None

    def result(self):
        return self.answer


class EndpointInfo:
    def __init__(self, topic_type):
        self.topic_type = topic_type


class FakeNode:
    def __init__(self, graph, name):
        self.graph, self.name, self.queue = graph, name, deque()

    def create_publisher(self, kind, topic, qos):
        assert qos.depth > 0
        self.graph.ends[topic].append((kind.NAME, True))
        graph = self.graph

        class Publisher:
            def publish(self, message):
                assert type(message) is kind
                for of, node, callback in graph.readers[topic]:
                    if of is kind:
                        node.queue.append((callback, (message,)))

            def get_subscription_count(self):
                return len(graph.readers[topic])

            def wait_for_all_acked(self, timeout):
                assert timeout.seconds > 0
                return True

        return Publisher()

    def create_subscription(self, kind, topic, callback, qos):
        self.graph.ends[topic].append((kind.NAME, False))
        self.graph.readers[topic].append((kind, self, callback))

    def create_service(self, kind, name, callback):
        self.graph.services[name] = (self, callback)

    def create_client(self, kind, name):
        graph = self.graph

        class Client:
            def wait_for_service(self, timeout_sec):
                return name in graph.services

            def call_async(self, request):
                node, callback = graph.services[name]
                future = Future()

                def answer():
                    future.answer = callback(request, kind.Response())

                node.queue.append((answer, ()))
                future.serve = lambda: FakeExecutor.drain(node)
                return future

        return Client()

    def get_publishers_info_by_topic(self, topic):
        return [EndpointInfo(kind) for kind, publishes in self.graph.ends[topic] if publishes]

    def get_subscriptions_info_by_topic(self, topic):
        return [EndpointInfo(kind) for kind, publishes in self.graph.ends[topic] if not publishes]

    def destroy_node(self):
        self.queue.clear()


class FakeExecutor:
    def add_node(self, node):
        self.node = node

    @staticmethod
    def drain(node):
        while node.queue:
            callback, arguments = node.queue.popleft()
            callback(*arguments)

    def spin_once(self, timeout_sec):
        assert timeout_sec >= 0
        if self.node.queue:
            callback, arguments = self.node.queue.popleft()
            callback(*arguments)

    def spin_until_future_complete(self, future, timeout_sec):
        future.serve()

    def shutdown(self):
        pass


def install(monkeypatch):
    """Put the stand-in where rclpy would be."""
    graph = Graph()

    def module(name, **contents):
        made = types.ModuleType(name)
        vars(made).update(contents)
        monkeypatch.setitem(sys.modules, name, made)
        return made

    class Duration:
        def __init__(self, *, seconds):
            self.seconds = seconds

    class Reliability:
        RELIABLE, BEST_EFFORT = 1, 2

    class QoSProfile:
        def __init__(self, *, depth, reliability):
            self.depth, self.reliability = depth, reliability

    def set_running(value):
        graph.running = value

    rclpy = module(
        "rclpy",
        ok=lambda: graph.running,
        init=lambda signal_handler_options: set_running(True),
        shutdown=lambda: set_running(False),
        create_node=lambda name: FakeNode(graph, name),
    )
    rclpy.duration = module("rclpy.duration", Duration=Duration)
    rclpy.executors = module("rclpy.executors", SingleThreadedExecutor=FakeExecutor)
    rclpy.signals = module("rclpy.signals", SignalHandlerOptions=type("SignalHandlerOptions", (), {"NO": 0}))
    rclpy.qos = module("rclpy.qos", QoSProfile=QoSProfile, ReliabilityPolicy=Reliability)
    packages = defaultdict(dict)
    for name, kind in classes.items():
        packages[name.partition("/")[0]][kind.__name__] = kind
    for package, contents in packages.items():
        module(package, msg=module(f"{package}.msg", **contents))
    module("std_srvs", srv=module("std_srvs.srv", Trigger=Trigger))
    monkeypatch.delitem(sys.modules, "jaxdrones.ros2.rclpy_transport", raising=False)
    return graph
