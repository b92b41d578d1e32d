"""What tests of the engine share with those of the service."""

from tests.service.conftest import redis_server, redis_settings, rq_queue

__all__ = ["redis_server", "redis_settings", "rq_queue"]
