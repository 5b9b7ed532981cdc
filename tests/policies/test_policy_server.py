"""LeRobot's asynchronous inference, over gRPC on this machine."""

import pickle
import time

import pytest
from fake_robot import MOTORS, FakeArm, FakeArmConfig
from small_policies import batch_of, demos_of, small_policy, with_chunks
from test_policy_lerobot import write_robot_dataset

grpc = pytest.importorskip("grpc", reason="needs lerobot[async]")


@pytest.mark.usefixtures("fake_language", "short_fit")
def test_a_policy_server_gives_chunks_and_a_connection_is_an_episode(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)  # where LeRobot writes the log of its server
    from concurrent import futures

    from lerobot.async_inference import constants, policy_server
    from lerobot.async_inference.configs import PolicyServerConfig
    from lerobot.async_inference.helpers import (
        RemotePolicyConfig,
        TimedObservation,
        map_robot_keys_to_lerobot_features,
    )
    from lerobot.transport import services_pb2, services_pb2_grpc
    from lerobot.transport.utils import send_bytes_in_chunks

    dataset = write_robot_dataset(tmp_path / "tasks", ["move it to the end"] * 24)
    demos = write_robot_dataset(tmp_path / "demos", ["drop it"])
    policy, before, after = small_policy(dataset, "deltaco_match", chunk_size=4, **demos_of(demos))
    policy(before(batch_of(with_chunks(dataset, policy.config), [0, 7, 14, 21])))
    for part in (policy, before, after):
        part.save_pretrained(tmp_path / "policy")
    served = policy_server.PolicyServer(PolicyServerConfig(host="127.0.0.1", port=1, fps=20))
    server = grpc.server(futures.ThreadPoolExecutor(max_workers=2))
    services_pb2_grpc.add_AsyncInferenceServicer_to_server(served, server)
    port = server.add_insecure_port("127.0.0.1:0")
    server.start()
    stub = services_pb2_grpc.AsyncInferenceStub(grpc.insecure_channel(f"127.0.0.1:{port}"))
    robot = FakeArm(FakeArmConfig())
    features = map_robot_keys_to_lerobot_features(robot)
    settings = RemotePolicyConfig("deltaco_match", str(tmp_path / "policy"), features, actions_per_chunk=50)

    def connect():
        stub.Ready(services_pb2.Empty())
        stub.SendPolicyInstructions(services_pb2.PolicySetup(data=pickle.dumps(settings)))

    def chunk(step):
        seen = {**robot.get_observation(), "task": "drop it"}
        data = pickle.dumps(TimedObservation(time.time(), step, seen, must_go=True))
        stub.SendObservations(send_bytes_in_chunks(data, services_pb2.Observation, silent=True))
        return [each.get_action() for each in pickle.loads(stub.GetActions(services_pb2.Empty()).data)]

    with pytest.raises(grpc.RpcError, match="Policy type deltaco_match not supported"):
        connect()  # LeRobot's own list, which `examples/policy_server.py` extends
    monkeypatch.setattr(
        constants, "SUPPORTED_POLICIES", supported := [*constants.SUPPORTED_POLICIES, "deltaco_match"]
    )
    monkeypatch.setattr(policy_server, "SUPPORTED_POLICIES", supported)
    for acting, length in (("replay", 1), ("network", 4)):
        connect()
        served.policy.config.acting = acting
        chunks = [chunk(step) for step in range(3)]
        assert {len(actions) for actions in chunks} == {length}
        assert all(0 <= action[MOTORS.index("gripper.pos")] <= 40 for action in chunks[0])
    server.stop(0)
