//! gRPC: wire to values and back. The only module that names proto.
