"""How long a learned simulator holds: minutes under the same actions as the true one, and what becomes of the picture.

`drives` what is commanded and what truly happens then, `films` frames of both and what is measured in each, `hidden`
things that come back into view, `tables` what the measures come to, `figures` their pictures.
"""
