"""Code shared by API and engine: settings, domain model, queue, object store, index, pipeline."""
