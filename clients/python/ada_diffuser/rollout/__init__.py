"""Episodes of the registered environments, driven through a running server, and what there is to say of them.

from ada_diffuser import Client
from ada_diffuser.rollout import Trial, evaluate

with Client("grpc://127.0.0.1:7777") as client:
    result = evaluate(client, Trial("cheetah-wind-s", episodes=50, seed=1000, vector=50))
print(result.mean_return, result.standard_error)
"""

from ada_diffuser.rollout.episodes import check, evaluate
from ada_diffuser.rollout.result import ActLog, Episode, Evaluation, Trial

__all__ = ["ActLog", "Episode", "Evaluation", "Trial", "check", "evaluate"]
