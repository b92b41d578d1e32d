"""What routes and pages read and do, as documents: index, store, queue and pipeline stand behind them.

Nothing is kept here between two requests but what may be lost, so any number of API processes answer alike. Methods
raise the errors of `service.model.errors`.
"""
