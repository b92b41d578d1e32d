"""What the front door and the engine room share: settings, domain model, queue, object store, index, pipeline."""
