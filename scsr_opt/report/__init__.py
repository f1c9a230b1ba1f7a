"""Ways to show a reconstruction: pictures and films in files, the figure, the report, progress.

    figure(solution).savefig("figure.png")
    Report.of(solution).write("report.json")
    write_picture("picture.png", solution.image, bits=16)

Names are looked up in their modules when first asked for: who only writes a picture need not wait for matplotlib.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
