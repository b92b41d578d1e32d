"""The fields of KEDA's kinds that graspd uses, as KEDA 2.14 and later document them; anything else is refused.

KEDA's own schemas hold the whole pod template and come with no package, so this says what the tests need of them.
"""

from __future__ import annotations

from typing import Any, Literal

from pydantic import BaseModel, ConfigDict, Field
from pydantic.alias_generators import to_camel


class _Strict(BaseModel):
    model_config = ConfigDict(extra="forbid", alias_generator=to_camel)


class RedisList(_Strict):
    """Metadata of the Redis list scaler. All values are strings, as KEDA wants them."""

    address: str = Field(pattern=r"^[a-z0-9.-]+:\d+$")
    list_name: str
    list_length: str = Field(pattern=r"^[1-9]\d*$")
    activation_list_length: str = Field("0", pattern=r"^\d+$")
    database_index: str = Field("0", pattern=r"^\d+$")
    enable_tls: Literal["true", "false"] = Field("false", alias="enableTLS")


class AuthenticationRef(_Strict):
    name: str


class Trigger(_Strict):
    type: Literal["redis"]
    metadata: RedisList
    authentication_ref: AuthenticationRef


class Rollout(_Strict):
    """`gradual`: a changed ScaledJob leaves running jobs alone; `default` ends them."""

    strategy: Literal["default", "gradual"]


class ScalingStrategy(_Strict):
    strategy: Literal["default", "custom", "accurate", "eager"]
    multiple_scalers_calculation: Literal["max", "min", "avg", "sum"]


class ScaledJobSpec(_Strict):
    job_target_ref: dict[str, Any]
    polling_interval: int = Field(30, gt=0)
    min_replica_count: int = Field(0, ge=0)
    max_replica_count: int = Field(100, gt=0)
    successful_jobs_history_limit: int = Field(100, ge=0)
    failed_jobs_history_limit: int = Field(100, ge=0)
    rollout: Rollout
    scaling_strategy: ScalingStrategy
    triggers: list[Trigger] = Field(min_length=1)


class SecretTarget(_Strict):
    parameter: Literal["password", "username"]
    name: str
    key: str


class TriggerAuthenticationSpec(_Strict):
    secret_target_ref: list[SecretTarget] = Field(min_length=1)
