"""Operations behind routes and pages, on index, store, queue and pipeline; they return API models."""
