r"""dentine: a capture of a person's teeth becomes a measured, renderable asset.

One house, data walks through it once::

    capture -> preprocess -> fit -> export      each stage reads and writes stores (services.core.store)
        \\_________ services.pipeline ________/   and passes only small records (services.core.records)

Rooms, and who may enter which (import-linter keeps it, see pyproject.toml):

* ``core``        what crosses a process boundary: records, errors, stores, geometry; imports no room
* ``anatomy``     teeth as solids: scans, roots, frames, blend shapes; imports core alone
* ``capture``     plan, dome and cameras, real and simulated; writes the capture store
* ``preprocess``  radiometry, stabilisation, highlight and valid masks; writes the prepared store
* ``fit``         light transport, its derivatives, the inverse problem, the exported asset
* ``phantom``     virtual mouths, subjects and rigs: what simulated cameras look at
* ``pipeline``    a job's stages on Dask, its workers and its event log: all that ``dentine run`` needs
* ``client``      the typed client of the API; needs neither database nor server
* ``api``         the server: jobs, captures, dome, webhooks, the page
* ``bench``       benchmarks and figures: what no job runs
* ``cli``         the command line, one file a command, and the composition root

``stage.py`` is the only door of a room that does a job's work.
"""
