"""The layouts of ONNX detectors: how each wants its images, and how its outputs become boxes.

An ONNX file states names, shapes and types of its inputs and outputs, but not what the numbers mean. Networks of
one *family* share that meaning. ``recognise.recognise`` finds the family of a file (the user's option wins, then the
file's metadata, then its inputs and outputs) together with the reason in words; from there on a ``family.Family`` packs
images into the network's input and decodes its outputs into ``Candidates``, boxes in pixels of that input.

======================= ============================ ===================================================================
format                  images                       outputs
======================= ============================ ===================================================================
``ultralytics``         RGB 0..1, centred on grey    [b, 4 + classes, n], [b, n, 4 + classes]: centre, size [px], scores
``ultralytics-end2end`` RGB 0..1, centred on grey    [b, n, 6]: x0, y0, x1, y1 [px], score, class
``ultralytics-rtdetr``  RGB 0..1, stretched          [b, n, 6]: centre, size in 0..1, score, class
``yolox``               BGR 0..255, top left on grey [b, n, 5 + classes]: offset, log size [cells], objectness, scores
``yolox-decoded``       BGR 0..255, top left on grey [b, n, 5 + classes]: centre, size [px], objectness, scores
``torchvision``         RGB 0..1, top left on grey   boxes, labels, scores in any order; class 0 is the background
``rtdetr``              RGB 0..1, stretched          labels, boxes, scores; second input: the size that boxes refer to
``rtdetr-single``       RGB 0..1, stretched          [b, n, 6]: x0, y0, x1, y1 [px], score, class
======================= ============================ ===================================================================

RT-DETR and D-FINE are trained, evaluated and deployed on images that are stretched to the square input, whatever their
shape, and so is ultralytics' RT-DETR; none of them is letterboxed here. torchvision pads its own batches at the right
and the bottom with what is the mean colour, a grey, after its normalisation.
"""
