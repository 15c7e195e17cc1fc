"""A node as far as what is written for nodes needs one, without ROS in the air."""

from types import SimpleNamespace

STARTED_NS = 1_000 * 10**9


class FakeNode:
    """Keeps what is published and logged; time stands still unless it is set.

    now_ns: of its clock;  given: parameters from outside, by name
    """

    def __init__(self, name="corrector", given=None):
        self.name, self.now_ns, self.simulated = name, STARTED_NS, False
        self.published, self.listening, self.logged = [], {}, []
        self.parameters = {}
        self.services = []
        self.callbacks = []
        self._parameter_overrides = {
            name: SimpleNamespace(value=value) for name, value in (given or {}).items()
        }

    # Publishers and subscriptions.

    def create_publisher(self, kind, topic, qos, **_):
        return SimpleNamespace(
            topic_name=topic, publish=lambda message: self.published.append((topic, message))
        )

    def create_subscription(self, kind, topic, callback, qos, **_):
        self.listening[topic] = callback
        return SimpleNamespace(topic_name=topic)

    def create_timer(self, *_, **__):
        return SimpleNamespace(cancel=lambda: None, reset=lambda: None)

    def create_service(self, kind, name, callback, **_):
        made = SimpleNamespace(srv_type=kind, name=name, callback=callback)
        self.services.append(made)
        return made

    def destroy_publisher(self, _): ...
    def destroy_subscription(self, _): ...
    def destroy_timer(self, _): ...
    def destroy_service(self, _): ...

    def messages(self, topic):
        return [message for where, message in self.published if where == topic]

    # Parameters.

    def declare_parameter(self, name, value, descriptor, ignore_override):
        self.parameters[name] = SimpleNamespace(value=value, descriptor=descriptor)

    def add_on_set_parameters_callback(self, callback):
        self.callbacks.append(callback)

    def has_parameter(self, name):
        return name in self.parameters

    def get_parameter(self, name):
        return self.parameters[name]

    # Itself.

    def get_name(self):
        return self.name

    def get_fully_qualified_name(self):
        return f"/omsm/{self.name}"

    def get_clock(self):
        def message():
            from builtin_interfaces.msg import Time

            return Time(sec=self.now_ns // 10**9, nanosec=self.now_ns % 10**9)

        now = SimpleNamespace(nanoseconds=self.now_ns, to_msg=message)
        return SimpleNamespace(ros_time_is_active=self.simulated, now=lambda: now)

    def get_logger(self):
        def log(level):
            return lambda text, **_: self.logged.append((level, text))

        return SimpleNamespace(**{level: log(level) for level in ("info", "warning", "error")})
