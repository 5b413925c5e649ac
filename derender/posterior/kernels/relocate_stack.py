"""Relocate-stack: objects that stand on each other are put down anew together, where warm-up saw them together."""

from derender.posterior.kernels.base import kernels
from derender.posterior.kernels.relocate import RelocateType
from derender.posterior.space import Block


@kernels.register("relocate-stack")
class RelocateStackType(RelocateType):
    """Put some objects of a stack down anew together, and leave what stands on them where it is.

    The step of `relocate` with w the places of all of them. What is hidden below may be seen to fit in two ways of
    which each needs both objects elsewhere: one at a time none of them can go.
    """

    options = {"objects": 2}

    def blocks(self, space, options):
        contacts = {block.objects[0]: block for block in space.blocks if block.name in space.relocations}
        found = []
        for name in contacts:
            stack = [name]
            while len(stack) < options["objects"] and stack[0] in space.below:
                stack.insert(0, space.below[stack[0]])
            if 1 < len(stack) == options["objects"]:
                blocks = [contacts[one] for one in stack]
                unknowns = tuple(i for block in blocks for i in block.unknowns)
                found.append(Block("+".join(block.name for block in blocks), unknowns))
        return found
