"""The index: all its parts on one database."""

from sqlalchemy import URL

from graspd.service.index.changes.records import Changes, DatasetChanges, LiveChanges
from graspd.service.index.changes.removals import Removals
from graspd.service.index.database import Database
from graspd.service.index.notes import KnownDamage, Notes
from graspd.service.index.outbox import Outbox
from graspd.service.index.queries.assets import Assets, ObjectSets
from graspd.service.index.queries.datasets import Datasets
from graspd.service.index.queries.feed import DatasetFeed, Feed
from graspd.service.index.queries.grasps import Grasps
from graspd.service.index.queries.jobs import Jobs, Shards
from graspd.service.index.queries.overview import Costs, Overview, Usage
from graspd.service.index.queries.statistics import Statistics
from graspd.service.index.tags import Tags


class Index:
    """SQL rows derived from the store; `url` is an SQLAlchemy URL.

    Only the API and the controller write to it. Every method raises IndexUnavailable if the database does not answer.
    Cursors are opaque, `limit` is at most 200, and an unknown id raises NotFoundError.
    """

    def __init__(self, url: str | URL, *, anew: bool = False) -> None:
        self.database = database = Database(url, anew=anew)
        self.jobs = Jobs(database)
        self.grasps = Grasps(database)
        self.shards = Shards(database)
        self.statistics = Statistics(database)
        self.datasets = Datasets(database)
        self.object_sets = ObjectSets(database)
        self.assets = Assets(database)
        self.costs = Costs(database)
        self.overview = Overview(database)
        self.usage = Usage(database)
        self.feed = Feed(database)
        self.dataset_feed = DatasetFeed(database)
        self.write = Changes(database)
        self.write_dataset = DatasetChanges(database)
        self.live = LiveChanges(database)
        self.removals = Removals(database)
        self.notes = Notes(database)
        self.damage = KnownDamage(database)
        self.outbox = Outbox(database)
        self.tags = Tags(database)

    def close(self) -> None:
        self.database.close()
