"""Operations of routes and pages, as documents; they use index, store, queue and pipeline.

State between requests is only a cache, so any number of API processes give the same answers. Methods raise the errors
of `service.model.errors`.
"""
