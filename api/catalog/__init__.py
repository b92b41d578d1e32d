"""Operations behind routes and pages; they return documents and use index, store, queue and pipeline.

State between requests is only a cache, so any number of API processes give the same answers. Methods raise the errors
of `service.model.errors`.
"""
