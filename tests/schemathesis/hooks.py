"""What schemathesis does not know by itself: the media type of resumable uploads is bytes."""

import schemathesis


@schemathesis.serializer("application/offset+octet-stream")
def offset_bytes(ctx, value):
    return value if isinstance(value, bytes) else str(value).encode()
