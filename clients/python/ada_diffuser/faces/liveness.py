"""When a peer that keeps silent is held to be gone, the same on both faces.

Of a server that is killed its kernel says so, at once. One whose machine or network is gone says nothing: without these bounds a call waits
for all of its timeout, and a connection that is idle is found to be dead by the next act.
"""

#: A connection stands within so long, or the call is `Unavailable`; a call with a shorter timeout ends before.
CONNECT_S = 5.0
#: A peer that was silent for so long is asked whether it is there.
SILENT_S = 10.0
#: One that does not answer that for so long is gone.
PROOF_S = 5.0
