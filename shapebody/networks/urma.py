"""What policy and critics are built of: the encoder of joints and feet (eq. 3), and the core.

In the Unified Robot Morphology Architecture (URMA) a robot is a set of joints and a set of feet,
each with a description d and an observation o. Every part is encoded on its own and the parts are
summed, so one network serves any number of them:

    latent = sum over parts of softmax(tanh(key(d, o)) / temperature) outer value

The softmax runs over the L entries of one part's key. So a key says to which rows of the latent,
and in which shares, this part adds its value: an address, not attention between parts.

The value is a function of o in the policy and in the original critic, and of (d, o) in the
direct-design critic. The sum, together with the general observations, enters a core network.

As in the published policies, the key layer sees the observation as well as the description, its
output passes a tanh, and key and value meet in an outer product; eq. (3) writes the description
only, no tanh and an elementwise product. The first key layer is linear in [d, o], so `embed`
computes the part that depends on the design once, and `act` (or `value`) adds the rest for every
state of that design.
"""

import jax
import jax.numpy as jnp
import numpy as np
from flax import linen as nn


def elu(x):
    """ELU. On a CPU about twice as fast as the form with `expm1`, exact to 1e-7."""
    return jnp.maximum(x, 0) + (jnp.exp(jnp.minimum(x, 0)) - 1)


class PartEncoder(nn.Module):
    """Encoder of one kind of part (joints or feet): keys, values and their sum (eq. 3)."""

    description_size: int
    observation_size: int
    key_widths: tuple[int, ...]
    value_latent: int
    direct_design: bool
    initial_temperature: float
    minimum_temperature: float
    latent_scale: float

    def setup(self):
        both = self.description_size + self.observation_size
        value_size = both if self.direct_design else self.observation_size
        weights, zeros = nn.initializers.lecun_normal(), nn.initializers.zeros
        width = self.key_widths[0]
        self.key_kernel = self.param("key_kernel", weights, (both, width))
        self.key_bias = self.param("key_bias", zeros, (width,))
        self.key_norm = nn.LayerNorm(epsilon=1e-6)
        self.key_layers = [nn.Dense(width) for width in self.key_widths[1:]]
        self.value_kernel = self.param("value_kernel", weights, (value_size, self.value_latent))
        self.value_bias = self.param("value_bias", zeros, (self.value_latent,))
        start = float(np.log(self.initial_temperature - self.minimum_temperature))
        self.log_temperature = self.param("log_temperature", nn.initializers.constant(start), (1,))

    def embed(self, descriptions):
        """Description-only summands of the first layers, [..., parts, width] each."""
        size = self.description_size
        embedding = {"key": descriptions @ self.key_kernel[:size] + self.key_bias}
        if self.direct_design:
            embedding["value"] = descriptions @ self.value_kernel[:size] + self.value_bias
        return embedding

    def temperature(self):
        """The learned temperature [1] of the softmax over a key."""
        return jnp.exp(self.log_temperature) + self.minimum_temperature

    def __call__(self, embedding, observations, mask):
        """Latent [..., L * value_latent], softmaxed keys and tanh keys [..., parts, L].

        Args:
            embedding: what `embed` made of the descriptions.
            observations: [..., parts, n].
            mask: [..., parts], 0 for padding.
        """
        size = self.description_size
        # Keys.
        hidden = embedding["key"] + observations @ self.key_kernel[size:]
        hidden = self.key_norm(hidden)
        for layer in self.key_layers:
            hidden = layer(elu(hidden))
        # The published clip of tanh to +-(1 - 1e-8) is the identity in float32.
        tanh_keys = jnp.tanh(hidden)
        keys = nn.softmax(tanh_keys / self.temperature(), axis=-1)
        # Values, of the observation alone unless the critic is a direct-design one.
        if self.direct_design:
            values = embedding["value"] + observations @ self.value_kernel[size:]
        else:
            values = observations @ self.value_kernel + self.value_bias
        values = elu(values) * (self.latent_scale * mask[..., None])
        return aggregate(keys, values), keys, tanh_keys


def aggregate(keys, values):
    """Sum over parts of the outer products of keys [..., parts, L] and values [..., parts, v].

    Returns [..., L * v], entry k * v + l holding key entry k times value entry l.
    """
    leading, latent, width = keys.shape[:-2], keys.shape[-1], values.shape[-1]
    keys = keys.reshape((-1,) + keys.shape[-2:])
    values = values.reshape((-1,) + values.shape[-2:])
    product = jax.lax.dot_general(keys, values, (((1,), (1,)), ((0,), (0,))))
    return product.reshape(leading + (latent * width,))


class WeightNormDense(nn.Module):
    """Dense layer with kernel scale * v / |v| per output (Salimans and Kingma, 2016)."""

    features: int

    @nn.compact
    def __call__(self, x):
        kernel = self.param("kernel", nn.initializers.lecun_normal(), (x.shape[-1], self.features))
        scale = self.param("scale", nn.initializers.ones, (self.features,))
        bias = self.param("bias", nn.initializers.zeros, (self.features,))
        norm = jnp.sqrt(jnp.sum(kernel * kernel, axis=0) + 1e-24)
        return x @ (kernel * (scale / norm)) + bias


class Core(nn.Module):
    """Weight-normalised layers with ELU between them and LayerNorm after the first one."""

    widths: tuple[int, ...]

    @nn.compact
    def __call__(self, x):
        for index, width in enumerate(self.widths):
            x = WeightNormDense(width, name=f"layer_{index}")(x)
            if index == 0:
                x = nn.LayerNorm(epsilon=1e-6, name="norm")(x)
            if index + 1 < len(self.widths):
                x = elu(x)
        return x
