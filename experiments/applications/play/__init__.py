"""A page on which people drive a trained model (`hma play`): visitors share one simulator, a batch for all of them.

`sessions` manages visitors and their pending requests, `requests` answers a round of these, `recording` is what
visitors download, `server` the HTTP and websocket routes, page.html what runs in the browser.
"""
