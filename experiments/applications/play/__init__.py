"""A page on which people drive a trained model (`hma play`): visitors share one simulator, a batch for all of them.

`crowd` is who is there and what they asked for, `turn` answers a round of it, `recording` is what they keep, `server`
the way in and out, page.html what runs in the browser.
"""
