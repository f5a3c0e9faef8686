//! Every limit and path, from flags and environment, validated once and immutable afterwards.
