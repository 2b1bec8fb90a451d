r"""dentine: a capture of a person's teeth becomes a measured, renderable asset.

One house, data walks through it once::

    capture -> preprocess -> fit -> export        each stage reads and writes stores (services.core.store)
        \\________ services.pipeline.stages ________/  and passes only small records (services.core.records)

Rooms, and who may enter which (import-linter keeps it, see pyproject.toml):

* ``core``        what crosses a process boundary: records, errors, stores, geometry; imports no service
* ``capture``     plan, dome and cameras, real and simulated; writes the capture store
* ``preprocess``  radiometry, stabilisation, highlight and valid masks; writes the prepared store
* ``fit``         light transport, its derivatives, the inverse problem, the exported asset
* ``api``         jobs, routes, dashboard, and the pipeline that strings the stages together

``stage.py`` is each service's only door. ``__main__`` is the composition root and the command line.
"""
