"""What the API and the engine share: settings, domain model, queue, object store, index, pipeline."""
