"""Operations behind routes and pages, on index, store, queue and pipeline; they return API models.

State between requests is only a cache, so any number of API processes give the same answers. Methods raise the errors
of `service.model.errors`.
"""
