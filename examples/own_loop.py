"""A training loop of your own, with any optimizer of torch: python examples/own_loop.py plates.h5"""

import sys

import torch

from ast_sim import Dataset, new_model


def main(path: str, steps: int = 300) -> list[float]:
    """Train a small AST; returns the loss of each step."""
    torch.manual_seed(0)
    losses = []
    with Dataset(path) as data:
        model = new_model(data)
        pairs = model.pairs(data, batch_size=4, noise=0.002)  # the noise is a length, in the unit of the data
        optimizer = torch.optim.AdamW(model.parameters(), lr=1e-3)
        for step in range(steps):
            batch, target = pairs.batch(step)
            loss = model.loss(model(batch), batch, target)["loss"]
            optimizer.zero_grad()
            loss.backward()
            optimizer.step()
            losses.append(loss.item())
            if step % 50 == 49:
                print(f"step {step + 1}: loss {sum(losses[-50:]) / 50:.3f}")
    return losses


if __name__ == "__main__":
    main(sys.argv[1])
